"""The map frame of a file of rules: where positions in degrees are in metres."""

from __future__ import annotations

from functools import cached_property
from math import isfinite
from typing import Annotated, Any

from pydantic import Field, StringConstraints, model_validator

from demandops.model.config.base_model import CamelModel
from demandops.model.config.inventory import Coordinate

FrameId = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_./-]*$")]
# A reference system by its authority and number, such as `EPSG:25832`
Crs = Annotated[str, StringConstraints(pattern=r"^[A-Z]+:[0-9]+$")]


class MapFrame(CamelModel):
    """A frame in metres, to the east and the north of a point on earth.

    The point is ``latitude`` and ``longitude``, or ``x`` and ``y`` of the projected reference
    system ``crs``. ``datum`` is the reference system of all degrees, by default WGS 84. ``frame``
    is its name in the tree of frames that ``/tf`` tells of.
    """

    frame: FrameId | None = None

    latitude: Annotated[float, Field(ge=-90, le=90)] | None = None
    longitude: Annotated[float, Field(ge=-180, le=180)] | None = None
    crs: Crs | None = None
    x: Coordinate = 0.0
    y: Coordinate = 0.0
    datum: Crs = "EPSG:4326"

    @model_validator(mode="after")
    def _has_one_origin(self) -> MapFrame:
        degrees = (self.latitude is not None, self.longitude is not None)
        if any(degrees) is not all(degrees) or (any(degrees) and self.crs):
            raise ValueError("needs either latitude and longitude, or crs with x and y")
        if not (any(degrees) or self.crs or self.frame):
            raise ValueError("needs either latitude and longitude, or crs with x and y, or frame")
        if not self.crs and (self.x or self.y):
            raise ValueError("has x or y, which belong to crs; leave them out")
        if self.on_earth:
            _ = self._transformer  # so that an unknown reference system is a fault of the file
        return self

    @property
    def on_earth(self) -> bool:
        return self.crs is not None or self.latitude is not None

    @cached_property
    def _transformer(self) -> Any:  # noqa: ANN401 - of a library without types
        try:
            import pyproj  # noqa: PLC0415 - only rules about degrees need it
        except ImportError:
            raise ValueError(
                "needs the library pyproj; install it with: pip install 'demandops[replay]'"
            ) from None
        origin = f"+proj=aeqd +lat_0={self.latitude} +lon_0={self.longitude} +datum=WGS84"
        try:
            target = pyproj.CRS(self.crs or origin)
            datum = pyproj.CRS(self.datum)
        except pyproj.exceptions.CRSError:
            known = f"{self.crs} or {self.datum}" if self.crs else self.datum
            raise ValueError(f"{known} is not a reference system that PROJ knows") from None
        if not target.is_projected or {a.unit_name for a in target.axis_info} != {"metre"}:
            raise ValueError(f"{self.crs} is not in metres; name a projected reference system")
        if not datum.is_geographic or datum.axis_info[0].unit_name != "degree":
            raise ValueError(f"datum {self.datum} is not in degrees; name a geographic one")
        return pyproj.Transformer.from_crs(datum, target, always_xy=True)

    def metres(self, latitude: float, longitude: float) -> tuple[float, float] | None:
        """Return x and y; ``None`` for a position that the frame does not have."""
        x, y = self._transformer.transform(longitude, latitude)
        return (x - self.x, y - self.y) if isfinite(x) and isfinite(y) else None
