"""The files of the reference's operators, and its custom resources.

Each operator keeps two files. The bookkeeping file maps a resource to the list of requesters that
hold the resource. A requester is listed as often as it joined. A fusion has such a list for each
topic. The versioning file maps a resource to its requests. The key of each request is the version
that the resource got by this request.

A file is recognized by its content, so it may have any name. Only a bookkeeping file without
entries (``{}``) is recognized by its name.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import PurePath
from typing import Any, TypeAlias, TypeVar

from pydantic import AliasPath, BaseModel, ConfigDict, Field

from demandops.config.base_model import parse
from demandops.errors import Fault, InvalidInput, fault
from demandops.quoting import quoted

CONNECTION, DETECTION, FUSION = "mqtt-connection-", "od-", "of-"
"""The prefixes of the resources' names; the rest of a name is made from ids."""

_BOOKS = {
    "mqtt_bookkeeping": CONNECTION,
    "object_detection_bookkeeping": DETECTION,
    "object_fusion_bookkeeping": FUSION,
}
"""Name of a bookkeeping file → prefix of its resources' names.

If the file contains only ``{}``, nobody holds a resource whose name has this prefix.
"""

_NUMBER = re.compile(r"[0-9]{1,20}")
_CLOUD = re.compile(r"\bpoint_cloud_topic:=(\S+)")

Hold: TypeAlias = "tuple[str, str]"
"""A topic and a requester that holds it; for a connection and a detection the topic is ``""``."""


class _Part(BaseModel):
    """A part of a file. Fields that the class does not list are ignored."""

    model_config = ConfigDict(frozen=True, strict=True, extra="ignore")


class Request(_Part):
    """A request to an operator: the fields that the operator reads."""

    requester: list[str]
    shutdown: bool
    topics_ego_data: list[str] = Field(default_factory=list, alias="topicsEgoData")
    topics_objectlist: list[str] = Field(default_factory=list, alias="topicsObjectlist")

    def holds(self) -> Counter[Hold]:
        """Return the holds that the request adds or, if it is a shutdown, removes."""
        topics = [*self.topics_ego_data, *self.topics_objectlist] or [""]
        return Counter((topic, who) for who in self.requester for topic in topics)


class _MqttTopic(_Part):
    mqtt_topic: str


class _RosTopic(_Part):
    ros_topic: str


class _Ros2Mqtt(_Part):
    """The bridge at the source of a connection.

    ``ros_topics`` lists the topics of the last request. Each topic of the last or an earlier
    request is also the name of a field.
    """

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, _MqttTopic] = Field(init=False)
    ros_topics: list[str] = Field(default_factory=list)


class _Mqtt2Ros(_Part):
    """The bridge at the target of a connection.

    ``mqtt_topics`` lists the topics of the last request. Each topic of the last or an earlier
    request is also the name of a field.
    """

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, _RosTopic] = Field(init=False)
    mqtt_topics: list[str] = Field(default_factory=list)


_BRIDGE = ("configMQTT", "bridge")


class MqttConnection(_Part):
    """The spec of a connection.

    If the initial deployment already carries the topics at one of the two ends, the fields of this
    end are empty.
    """

    operator: Request
    host: str = Field(validation_alias=AliasPath("configCommon", "broker", "host"))
    port: int = Field(validation_alias=AliasPath("configCommon", "broker", "port"))
    source: str = Field("", validation_alias=AliasPath("configSource", "nodeSelector", "node_id"))
    target: str = Field("", validation_alias=AliasPath("configTarget", "nodeSelector", "node_id"))
    ros2mqtt: _Ros2Mqtt = Field(
        _Ros2Mqtt(), validation_alias=AliasPath("configSource", *_BRIDGE, "ros2mqtt")
    )
    mqtt2ros: _Mqtt2Ros = Field(
        _Mqtt2Ros(), validation_alias=AliasPath("configTarget", *_BRIDGE, "mqtt2ros")
    )

    def topics(self) -> list[tuple[str, str]]:
        """Return the topics of the last request, each with its name at both ends.

        The result is empty if the fields of one end are empty.
        """
        targets = self.mqtt2ros.__pydantic_extra__
        names = [targets[one].ros_topic for one in self.mqtt2ros.mqtt_topics if one in targets]
        return list(zip(self.ros2mqtt.ros_topics, names, strict=False))

    def dropped_topics(self) -> list[str]:
        """Return the topics that an earlier request listed but the last request did not."""
        return sorted(set(self.ros2mqtt.__pydantic_extra__) - {*self.ros2mqtt.ros_topics})


class ObjectDetection(_Part):
    """The spec of a detection. Each node has one detection for each source of a point cloud."""

    operator: Request
    node: str = Field(validation_alias=AliasPath("nodeSelector", "node_id"))
    ros_name: str = Field(validation_alias=AliasPath("configDetection", "ros_node_name"))
    command: list[str] = Field(alias="commandOverride")

    @property
    def source(self) -> str:
        """The node that publishes the detection's point cloud."""
        return self.ros_name.removeprefix("pcod_")

    @property
    def topic(self) -> str:
        """The point cloud's topic in ``commandOverride``; empty if the command names no topic."""
        found = _CLOUD.search(" ".join(self.command))
        return found[1] if found else ""


class ObjectFusion(_Part):
    """The spec of a fusion. Each application has one fusion."""

    operator: Request
    node: str = Field(validation_alias=AliasPath("fusion", "nodeSelector", "node_id"))


Spec: TypeAlias = MqttConnection | ObjectDetection | ObjectFusion
SpecType = TypeVar("SpecType", MqttConnection, ObjectDetection, ObjectFusion)

KINDS: dict[str, type[Spec]] = {
    "MqttConnection": MqttConnection,
    "ObjectDetection": ObjectDetection,
    "ObjectFusion": ObjectFusion,
}
"""The class of the spec, by the kind of the custom resource."""


class _Metadata(_Part):
    name: str = Field(validation_alias=AliasPath("metadata", "name"))


class _Book(_Part):
    requesters: list[str]


class _FusionBook(_Part):
    topics_ego_data: dict[str, list[str]] = Field(alias="topicsEgoData")
    topics_objectlist: dict[str, list[str]] = Field(alias="topicsObjectlist")


@dataclass
class ReferenceFiles:
    """The content of all files: the spec, bookkeeping and requests of each resource, by name."""

    specs: dict[str, Spec] = field(default_factory=dict)
    books: dict[str, Counter[Hold]] = field(default_factory=dict)
    versions: dict[str, dict[int, Request]] = field(default_factory=dict)
    booked: set[str] = field(default_factory=set)
    """The prefixes of the resources whose bookkeeping file was given; the file may be empty."""

    def specs_of(self, kind: type[SpecType]) -> dict[str, SpecType]:
        """Return a map from name to spec, for the resources with a spec of this class."""
        return {name: spec for name, spec in sorted(self.specs.items()) if isinstance(spec, kind)}

    def names(self) -> list[str]:
        """Return the names of all resources."""
        return sorted({*self.specs, *self.books, *self.versions})


def read(documents: Iterable[tuple[str, object]]) -> ReferenceFiles:
    """Return the content of all documents. ``documents`` are pairs of a file's name and a document.

    Raises:
        InvalidInput: with the faults of all documents; of each document, only those of its first
            invalid entry.
    """
    found, faults = ReferenceFiles(), list[Fault]()
    for file, document in documents:
        try:
            _read(found, file, document)
        except InvalidInput as error:
            faults += error.faults
    if faults:
        raise InvalidInput(faults)
    return found


def _read(found: ReferenceFiles, file: str, document: object) -> None:
    if document is None:
        message = (
            "is empty, perhaps because an operator was stopped while it wrote the file; leave the "
            "file out, or list in it who holds each resource, such as "
            "'mqtt-connection-vehicle00-edge: [vehicle00]'"
        )
        raise InvalidInput.at("", message, file=file)
    if not isinstance(document, dict):
        raise InvalidInput.at("", _UNKNOWN, file=file)
    if "kind" in document:
        listed = document.get("items")
        items = listed if isinstance(listed, list) else [document]
        for index, item in enumerate(items):
            _read_resource(found, file, f"items[{index}]" if items is listed else "", item)
        return
    if not document and (prefix := _BOOKS.get(PurePath(file).stem)):
        found.booked.add(prefix)
    for name, value in document.items():
        _read_entry(found, file, name, value)


_UNKNOWN = (
    "is no file of the reference; give the bookkeeping and versioning files of the reference's "
    "operators, and its custom resources as `kubectl get -o yaml` prints them"
)


def _read_resource(found: ReferenceFiles, file: str, where: str, item: Any) -> None:  # noqa: ANN401
    kind = item.get("kind") if isinstance(item, dict) else None
    spec = KINDS.get(str(kind))
    if spec is None:
        message = (
            f"{quoted(str(kind))} is not a kind of custom resource that the reference has; known: "
            f"{', '.join(KINDS)}"
        )
        raise InvalidInput.at(f"{where}.kind".lstrip("."), message, file=file)
    name = parse(_Metadata, item, file).name
    _add(found.specs, name, parse(spec, item.get("spec"), f"{file}: {name}"), file)


def _read_entry(found: ReferenceFiles, file: str, name: str, value: object) -> None:
    prefix = next((one for one in (CONNECTION, DETECTION, FUSION) if name.startswith(one)), None)
    if prefix is None:
        raise InvalidInput([fault(name, _UNKNOWN).within(file)])
    if isinstance(value, list):
        book = parse(_Book, {"requesters": value}, f"{file}: {name}")
        _add(found.books, name, Counter(("", who) for who in book.requesters), file)
    elif isinstance(value, dict) and "topicsEgoData" in value:
        fusion = parse(_FusionBook, value, f"{file}: {name}")
        topics = [*fusion.topics_ego_data.items(), *fusion.topics_objectlist.items()]
        holds = Counter((topic, who) for topic, requesters in topics for who in requesters)
        _add(found.books, name, holds, file)
    elif isinstance(value, dict):
        entries = {}
        for version, request in value.items():
            if not _NUMBER.fullmatch(version):
                message = "is not a number; name each request by a version of the resource, like 3"
                raise InvalidInput([fault(f"{name}.{version}", message).within(file)])
            entries[int(version)] = parse(Request, request, f"{file}: {name}: {version}")
        _add(found.versions, name, dict(sorted(entries.items())), file)
        return
    else:
        raise InvalidInput([fault(name, _UNKNOWN).within(file)])
    found.booked.add(prefix)


Value = TypeVar("Value")


def _add(known: dict[str, Value], name: str, value: Value, file: str) -> None:
    if name in known:
        message = "appears twice, perhaps from different times; give it only once"
        raise InvalidInput([fault(name, message).within(file)])
    known[name] = value
