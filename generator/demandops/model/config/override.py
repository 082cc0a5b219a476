"""Overrides: a person's declared deviations, one file each in ``overrides/``.

This module has the model and the rules for one override. :mod:`.cross_check` finds conflicts
between two of them, and ``decide.planning.overrides`` applies overrides to releases and claims.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, Field, StringConstraints, ValidationError, model_validator

from demandops.base.errors import InvalidInput, sentences
from demandops.base.naming import id_problem
from demandops.base.quoting import quoted
from demandops.model.config import base_model
from demandops.model.config.base_model import (
    DnsLabel,
    FileModel,
    FrozenModel,
    Items,
    Pattern,
    Visible,
    matches,
    parse_time,
    time_text,
)
from demandops.model.config.inventory import LabelKey, LabelValue, NodeId
from demandops.model.config.registry import ClientSettings, Image, ImagePin, MqttClientSettings
from demandops.templating.charts import overridden

OVERRIDES_ROOT = "overrides"

_SHAPING = ("values", "version", "images", "replicas", "node")
_OF_SERVICES = ("version", "replicas", "node")
# The effects of overrides, in the order in which messages list them
EFFECTS = (*_SHAPING, "hold", "deny", "refuseNew", "keep")


def format_time(moment: datetime) -> str:
    return re.sub(r"\.?0*Z$", "Z", time_text(moment))


def _one_line(text: str) -> str:
    if not text.strip() or text != text.strip():
        raise ValueError("is empty or starts or ends with white space; write one line of text")
    if not text.isprintable():
        raise ValueError(f"{quoted(text)} is more than one line of plain text; write one line")
    return text


def _not_empty(items: tuple[Any, ...]) -> tuple[Any, ...]:
    if not items or "" in items:
        raise ValueError("is empty or has an empty item; name what to select")
    return items


Patterns = Annotated[Items[Pattern], AfterValidator(_not_empty)]
Line = Annotated[str, StringConstraints(max_length=300), AfterValidator(_one_line)]


def _filled_in(model: FrozenModel) -> None:
    # a field without a value would have no effect, and a person would wait for one
    empty = [name for name in sorted(model.model_fields_set) if getattr(model, name) is None]
    if empty:
        raise ValueError(
            sentences(f"'{name}' has no value; add one, or remove '{name}'" for name in empty)
        )


class Selector(FrozenModel):
    """Selects the releases and claims that match every field given here.

    Patterns may contain ``*`` and ``?``. ``requesters`` matches if a pattern matches one requester
    of the release or claim.
    """

    applications: Patterns | None = None
    appdefs: Patterns | None = None
    services: Patterns | None = None
    connections: Patterns | None = None
    nodes: Patterns | None = None
    requesters: Patterns | None = None
    labels: Annotated[dict[LabelKey, LabelValue], Field(min_length=1)] | None = None

    @model_validator(mode="after")
    def _sensible(self) -> Selector:
        if not self.model_fields_set:
            raise ValueError("selects nothing; give at least one field, for example nodes: ['*']")
        _filled_in(self)
        others = [name for name in ("applications", "appdefs", "services") if getattr(self, name)]
        if self.connections and others:
            raise ValueError(
                f"one selector cannot have both 'connections' and '{others[0]}', because nothing "
                "matches both; write a selector for each"
            )
        return self

    def takes(self, service: str, appdef: str) -> bool:
        return (not self.services or matches(service, self.services)) and (
            not self.appdefs or matches(appdef, self.appdefs)
        )


# What an override selects by name: "application", "node" and so on.
SELECTED = tuple(field[:-1] for field in Selector.model_fields if field != "labels")


class OverrideFile(FileModel):
    """``overrides/<name>.yaml``. Of several overrides for a release, the highest priority wins."""

    kind: Literal["Override"]
    reason: Line
    owner: Annotated[
        str,
        StringConstraints(max_length=100),
        base_model.without(id_problem),
        AfterValidator(_one_line),
    ]
    priority: Annotated[int, Field(ge=-1_000_000, le=1_000_000)] = 0
    expires: Annotated[str, base_model.readable_by(parse_time)] | None = None
    select: Annotated[Items[Selector], AfterValidator(_not_empty)]
    values: Annotated[dict[str, Any], Field(min_length=1)] | None = None
    version: Annotated[str, StringConstraints(min_length=1, max_length=63), Visible] | None = None
    images: Annotated[dict[DnsLabel, ImagePin], Field(min_length=1)] | None = None
    replicas: Annotated[int, Field(ge=0, le=1000)] | None = None
    node: NodeId | None = None
    hold: Literal[True] | None = None
    deny: Literal[True] | None = None
    # Refuses what is new; what runs stays, and may be renewed and released
    refuseNew: Literal[True] | None = None
    keep: Literal[True] | None = None

    @model_validator(mode="after")
    def _consistent(self) -> OverrideFile:
        _filled_in(self)
        problems: list[str] = []
        effects = self.effects()
        if not effects:
            problems.append(f"has no effect; give at least one of {', '.join(EFFECTS)}")
        if "deny" in effects and len(effects) > 1:
            others = " and ".join(f"'{name}'" for name in effects if name != "deny")
            problems.append(
                f"with 'deny', nothing runs, so {others} cannot apply; remove 'deny', or remove "
                f"{others}"
            )
        frozen = " and ".join(f"'{name}'" for name in effects if name in _SHAPING)
        if "hold" in effects and frozen:
            problems.append(
                f"'hold' freezes the release, so {frozen} cannot apply; remove 'hold', or remove "
                f"{frozen}"
            )
        selects_clients = any(selector.connections for selector in self.select)
        if self.values is not None and selects_clients and not self.patches_clients():
            problems.append(
                "select: selects both connections and services, but 'values' fits only connections "
                "(settings of clients) or only services (Helm values); write two overrides"
            )
        of_services = [name for name in effects if name in _OF_SERVICES]
        for index, selector in enumerate(self.select):
            if selector.connections and of_services:
                problems.append(
                    f"select[{index}].connections: '{of_services[0]}' is for services, but this "
                    f"selector selects connections; remove 'connections' or '{of_services[0]}'"
                )
            if selector.requesters and "node" in effects:
                problems.append(
                    f"select[{index}].requesters: 'node' moves a service for all its "
                    "requesters, so it cannot be limited to some of them; select by applications, "
                    "appdefs, services, nodes or labels"
                )
            if selector.services and "keep" in effects:
                problems.append(
                    f"select[{index}].services: 'keep' applies to applications and connections "
                    "only; select those"
                )
        if problems:
            raise ValueError(sentences(problems))
        return self

    def patches_clients(self) -> bool:
        return all(selector.connections for selector in self.select)

    def effects(self) -> tuple[str, ...]:
        return tuple(name for name in EFFECTS if getattr(self, name) is not None)

    @property
    def end(self) -> datetime | None:
        return parse_time(self.expires) if self.expires else None


def override_selects(text: str, kind: str, name: str) -> bool:
    """Return whether a file's text selects a thing by its name; one that is not valid does not."""
    try:
        selectors = base_model.parse_file(OverrideFile, text, "").select
    except InvalidInput:
        return False
    return any(matches(name, getattr(each, f"{kind}s") or ()) for each in selectors)


class Override(OverrideFile):  # noqa: PLW1641 - overrides contain mappings, so they have no hash
    """An override with its name, which is its file's name."""

    name: str

    @classmethod
    def from_file(cls, name: str, file: OverrideFile) -> Override:
        return cls.model_construct(file.model_fields_set | {"name"}, **dict(file), name=name)

    def __eq__(self, other: object) -> bool:
        # as JSON, because 1, True and 1.0 are equal in Python, but not for a chart
        return isinstance(other, Override) and self.model_dump_json() == other.model_dump_json()

    @property
    def path(self) -> str:
        return f"{OVERRIDES_ROOT}/{self.name}.yaml"


@dataclass(frozen=True, slots=True)
class Shaping:
    """The overrides that shape a release, each with the names of its effects on the release."""

    # In the order in which they apply; the last one wins
    by: tuple[tuple[Override, tuple[str, ...]], ...] = ()

    def image(self, name: str, image: Image) -> Image:
        for override, effects in self.by:
            if "images" in effects and override.images and name in override.images:
                image = override.images[name].over(image)
        return image

    @property
    def patches(self) -> tuple[tuple[str, Mapping[str, Any]], ...]:
        return tuple(
            (override.path, override.values or {})
            for override, effects in self.by
            if "values" in effects
        )

    @property
    def held(self) -> bool:
        held = False
        for _, effects in self.by:
            # one that applies later and changes the release cancels the hold
            held = "hold" in effects or (held and set(effects) <= {"keep"})
        return held


UNSHAPED = Shaping()


Settings = TypeVar("Settings", bound=ClientSettings)


def patched_settings(settings: Settings, patch: Mapping[str, Any], file: str) -> Settings:
    data = overridden(settings.model_dump(by_alias=True), patch, {})
    if isinstance(resources := data.setdefault("resources", {}), dict):
        for name in ("requests", "limits"):  # null removes what a client has by default, too
            resources.setdefault(name, {})
    own, of_mqtt = (
        {field.alias for field in model.model_fields.values()}
        for model in (type(settings), MqttClientSettings)
    )
    try:
        # one override may select clients of several types, of which only MQTT has further fields
        return settings.model_validate({k: v for k, v in data.items() if k not in of_mqtt - own})
    except ValidationError as error:
        raise InvalidInput(base_model.faults_of(error, type(settings), file, ("values",))) from None
