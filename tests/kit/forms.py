"""A configuration and goals in which every field has a value, and copies with one mistake each."""

from __future__ import annotations

import copy
import re
from collections.abc import Container, Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import jsonschema_rs
from demandops.base.errors import Fault
from demandops.model.config.appdef import ApplicationDefinition, ServiceDefinition
from demandops.model.config.inventory import BrokersFile, ClustersFile, NodesFile
from demandops.model.config.override import OverrideFile
from demandops.model.config.policy import AccessDomainsFile
from demandops.model.config.registry import ChartsFile, ClientsFile, ImagesFile, VersionsFile
from demandops.model.config.repo_settings import RepoSettings
from demandops.model.demand.goals import DemandGoal, WireGoal
from pydantic import BaseModel

from tests.kit import plain_yaml
from tests.kit.chance import IN_FULL, TIMES
from tests.kit.config import configuration, texts_below
from tests.kit.goals import CLOUD, EGO, Goal, application, connection, goal

APPDEF = "appdefs/object-detection-fusion/appdef.yaml"
CONFIG_MODELS: dict[str, type[BaseModel]] = {
    "demandops.yaml": RepoSettings,
    "inventory/brokers.yaml": BrokersFile,
    "inventory/clusters.yaml": ClustersFile,
    "inventory/nodes.yaml": NodesFile,
    "policy/access-domains.yaml": AccessDomainsFile,
    "registry/charts.yaml": ChartsFile,
    "registry/images.yaml": ImagesFile,
    "registry/clients.yaml": ClientsFile,
    "registry/versions.yaml": VersionsFile,
    APPDEF: ApplicationDefinition,
    "appdefs/lidar-driver/service.yaml": ServiceDefinition,
    "overrides/values.yaml": OverrideFile,
}
GOAL_MODELS: tuple[type[BaseModel], ...] = (WireGoal, DemandGoal)
_FOLDER = Path(__file__).parents[1] / "fixtures" / "rich"


def rich() -> dict[str, str]:
    """Return the files of a valid configuration with every field except ``proposals.api``."""
    files = configuration(texts_below(_FOLDER / "state-repo"))
    charts = "appdefs/object-detection-fusion/charts"
    chart = files[f"{charts}/object-detection/Chart.yaml"]
    files[f"{charts}/object-detection-next/Chart.yaml"] = chart.replace("0.1.0", "0.3.0", 1)
    return files


def rich_with_api() -> dict[str, str]:
    """Return the files of :func:`rich`, but for Argo CD and with ``proposals.api``."""
    return rich() | {"demandops.yaml": texts_below(_FOLDER)["proposals-by-api.yaml"]}


def reference_goal() -> Goal:
    """Return a valid goal of the reference's action with every field."""
    topics = [EGO[0], CLOUD[0]]
    made = goal([application(ego=[EGO])], [connection(topics=topics, targets=["/a", "/b"])])
    body = made["apps"][0]["object_detection_fusion_app"]
    body["pointcloud_topics"][0]["type"] = "sensor_msgs/msg/PointCloud2"
    return made


def own_goal() -> Goal:
    """Return a valid demand in our own format with every field."""
    made: Goal = plain_yaml.load(texts_below(_FOLDER)["own-goal.yaml"])
    return made


# ---- mistakes ----

Place = tuple[str | int, ...]
Schema = dict[str, Any]

_WRONG_TYPES: dict[str, Any] = {
    "a mapping": {"x": 1}, "a list": [1], "a number": 5, "a truth": True, "no value": None,
}  # fmt: skip
_OF_TYPE: dict[type, dict[str, Any]] = {
    str: {"empty": "", "too long": "x" * 2000, "another word": "Nonsense?"},
    bool: {},
    int: {"negative": -1, "zero": 0, "large": 10**30, "a fraction": 1.5},
    float: {"negative": -1.0, "large": 1e30},
    list: {"empty": []},
    dict: {"empty": {}},
}  # fmt: skip
_SAME = {str: "text", bool: "a truth", int: "a number", list: "a list", dict: "a mapping"}


class Mutation(NamedTuple):
    """A copy of a document with one mistake, and the value before it; a misspelt field moves."""

    place: Place
    kind: str
    document: Any
    value: Any
    new_place: Place

    def is_at(self, field: str) -> bool:
        """Return whether a fault names the mistake's place, or a place inside or around it."""
        return any(_overlaps(field, path(place)) for place in (self.place, self.new_place))

    def names(self) -> set[str]:
        """Return keys and texts of which a fault at another place must quote one."""
        names = {str(part) for part in self.place}
        values = [self.value]
        while values:
            value = values.pop()
            if isinstance(value, dict | list):
                values += value
                values += value.values() if isinstance(value, dict) else ()
            elif isinstance(value, str):
                names.add(value)
        return names


def mutations(document: Any, limits: Iterable[int] = ()) -> Iterator[Mutation]:
    """Yield mutations at each place of a document: all of them, or in `make test` every third."""
    return islice(_mutations(document, limits), 0, None, 1 if IN_FULL else 3)


def _mutations(document: Any, limits: Iterable[int]) -> Iterator[Mutation]:
    """Yield mutations at each place; what is tried changes from place to place."""
    for turn, place in enumerate(places(document)):
        value = at(document, place)
        wrong = {kind: new for kind, new in _WRONG_TYPES.items() if kind != _SAME.get(type(value))}
        if not isinstance(value, str):
            wrong["text"] = "x"
        wrong = _in_turn(wrong, turn)
        if isinstance(value, bool):
            wrong["the opposite"] = not value
        elif isinstance(value, int):
            wrong |= {f"{limit}": limit for limit in limits}
        elif isinstance(value, str):
            wrong |= _in_turn({"reversed text": f"{value}\u202eb", "a bell": f"{value}\ab"}, turn)
        for kind, new in (wrong | _OF_TYPE[type(value)]).items():
            if new != value or type(new) is not type(value):
                yield Mutation(place, kind, _replaced(document, place, new), value, place)
        holder = copy.copy(at(document, place[:-1]))
        del holder[place[-1]]
        yield Mutation(place, "removed", _replaced(document, place[:-1], holder), value, place)
        if isinstance(value, dict):
            more = {**value, "zz": {"q": [1]}}
            added = (*place, "zz")
            yield Mutation(added, "added", _replaced(document, place, more), None, added)
        if isinstance(place[-1], str):
            holder, key = at(document, place[:-1]), place[-1]
            own = re.sub("[A-Z]", lambda capital: f"_{capital[0].lower()}", key)
            for kind, name in (("misspelt", "Zz?"), ("the program's own name", own)):
                if name != key:
                    renamed = {k if k != key else name: v for k, v in holder.items()}
                    changed = _replaced(document, place[:-1], renamed)
                    yield Mutation(place, kind, changed, value, (*place[:-1], name))


def _in_turn(mistakes: dict[str, Any], turn: int) -> dict[str, Any]:
    """Return one mistake, chosen by ``turn``; all mistakes if ``DEMANDOPS_EXAMPLES`` is above 1."""
    kinds = [*mistakes] if TIMES > 1 else [[*mistakes][turn % len(mistakes)]]
    return {kind: mistakes[kind] for kind in kinds}


def places(document: Any, place: Place = ()) -> Iterator[Place]:
    entries: Any = ()
    if isinstance(document, dict):
        entries = document.items()
    elif isinstance(document, list):
        entries = enumerate(document)
    for key, value in entries:
        yield (*place, key)
        yield from places(value, (*place, key))


def at(document: Any, place: Place) -> Any:
    for key in place:
        document = document[key]
    return document


def _replaced(document: Any, place: Place, value: Any) -> Any:
    """Return a copy of a document with another value at a place; all other parts are shared."""
    if not place:
        return value
    changed = copy.copy(document)
    changed[place[0]] = _replaced(document[place[0]], place[1:], value)
    return changed


def path(place: Place) -> str:
    """Return a place as faults name it: ``nodes[1].id``."""
    text = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in place)
    return text.removeprefix(".")


def _overlaps(field: str, place: str) -> bool:
    """Return whether ``field`` is ``place``, is inside it, or contains it."""
    short, long = sorted((field, place), key=len)
    return (long.startswith(short) and (long[len(short) :] or ".")[0] in ".[") or not short


def problem(
    mutation: Mutation, faults: Sequence[Fault], form: Form, *, free: Container[str], file: str = ""
) -> str:
    """Return what is wrong with the faults found in a mutation, or an empty string.

    - If the schema forbids the mutated document, a fault must be at the mutation's place.
    - If a text outside the ``free`` fields got a control character, a fault must be there too.
    - A fault at the mutation's place must not contain words of Python.
    - A fault at another place must quote one of the mutation's :meth:`~Mutation.names`.
    """
    place = path(mutation.place)
    here = [found for found in faults if found.file == file and mutation.is_at(found.field)]
    control = mutation.kind in ("reversed text", "a bell")
    in_free = any(path(mutation.place[:end]) in free for end in range(1, len(mutation.place) + 1))
    if not here and (form.forbids(mutation.document) or (control and not in_free)):
        return f"{place}, {mutation.kind}: no fault there, but {[*map(str, faults)]}"
    if any(" instance of " in found.message for found in here):
        return f"{place}, {mutation.kind}: words of Python in {[*map(str, here)]}"
    names = mutation.names()
    astray = [
        str(found)
        for found in faults
        if found not in here and not names & set(re.findall(r"'([^']*)'", found.message))
    ]
    return f"{place}, {mutation.kind}: faults elsewhere: {astray}" if astray else ""


class Form:
    """A JSON schema: which documents it rejects, and which fields it describes."""

    def __init__(self, schema: Schema) -> None:
        self._schema = schema
        self._validator = jsonschema_rs.validator_for(schema)

    def forbids(self, document: Any) -> bool:
        return not self._validator.is_valid(document)

    def fields(self) -> set[str]:
        """Return all fields of all mappings in the schema, as ``Node.id``."""
        return {name for name, _ in self._options()}

    def limits(self) -> list[int]:
        """Return the numbers that just miss a field's range: minimum - 1 and maximum + 1."""
        beyond = (("minimum", -1), ("maximum", 1))
        return sorted({o[key] + by for _, o in self._options() for key, by in beyond if key in o})

    def free(self) -> set[str]:
        """Return the fields whose value may be anything, or a mapping with any keys."""
        return {
            name
            for name, option in self._options()
            if option.get("additionalProperties") is True
            or not {"type", "$ref", "const", "enum"} & option.keys()
        }

    def _options(self) -> Iterator[tuple[str, Schema]]:
        """Yield each field, as ``Node.id``, with each schema that its value may have."""
        for part in (self._schema, *self._schema.get("$defs", {}).values()):
            for name, field in part.get("properties", {}).items():
                for option in field.get("anyOf", [field]):
                    yield f"{part['title']}.{name}", option

    def fields_in(self, document: Any) -> set[str]:
        return set(self._used(document, self._schema))

    def _used(self, value: Any, schema: Schema) -> Iterator[str]:
        if "$ref" in schema:
            schema = self._schema["$defs"][schema["$ref"].rpartition("/")[2]]
        for option in schema.get("anyOf", ()):
            yield from self._used(value, option)
        if isinstance(value, list) and "items" in schema:
            for item in value:
                yield from self._used(item, schema["items"])
        if not isinstance(value, dict):
            return
        named = schema.get("properties", {})
        patterns = list(schema.get("patternProperties", {}).values())
        other = patterns[0] if patterns else schema.get("additionalProperties")
        for key, inner in value.items():
            if key in named:
                yield f"{schema['title']}.{key}"
            below = named.get(key, other)
            if isinstance(below, dict):
                yield from self._used(inner, below)
