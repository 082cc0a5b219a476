"""Charts in folders of the state repo: the libraries that they depend on, and their default values.

Pure: functions take the files as a mapping of paths to texts, and a chart as the path of its
folder. Like Flux and Argo CD, this module reads a library from the folder that ``repository:
file://…`` in ``Chart.yaml`` names. The folder must be in ``appdefs/``.
"""

from __future__ import annotations

import copy
import posixpath
import re
from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from demandops.base import strict_yaml
from demandops.base.errors import Fault, InvalidInput, fault
from demandops.base.quoting import quoted

_LOCAL = "file://"
_EXACT = re.compile(r"\d+\.\d+\.\d+")
# Names become folders in charts/, so they have the characters that Helm allows, and no others.
_NAME = re.compile(r"(?!\.{1,2}$)[A-Za-z0-9._-]{1,250}")

_ARCHIVE = re.compile(r"(?i)(?:^|/)charts/[^/]+\.tgz$")
# Charts of the examples have one library and fewer than 20 files. Libraries that depend twice on
# the next library double the copies at each step.
_MOST_LIBRARIES = 100
_MOST_FILES = 5_000
_MOST_CHARACTERS = 20_000_000


@dataclass(frozen=True, slots=True)
class Dependency:
    """An entry of a chart's ``dependencies``."""

    index: int  # in the list
    name: str  # as Helm allows it, so it is safe in a path
    alias: str
    version: str
    repository: str
    # That in `appdefs/` which `repository` names, if any; the state repo may lack the folder
    folder: str | None
    imports: tuple[str, ...]  # the names in the library's `exports` whose values are imported
    optional: bool  # values decide whether the chart has it


def dependencies(folder: str, files: Mapping[str, str]) -> tuple[Dependency, ...]:
    return _metadata(folder, files.get(f"{folder}/Chart.yaml", ""))[0]


def folders(folder: str, files: Mapping[str, str]) -> tuple[str, ...]:
    # of the chart and of the libraries that it needs, missing or not
    needed = [folder]
    for chart in needed:  # which grows meanwhile
        libraries = dict.fromkeys(library.folder for library in dependencies(chart, files))
        needed += [library for library in libraries if library and library not in needed]
        if len(needed) > _MOST_LIBRARIES:  # with_libraries refuses such a chart
            break
    return tuple(needed)


def below(folder: str, paths: Sequence[str]) -> Sequence[str]:
    # "0" is the character after "/"
    return paths[bisect_left(paths, f"{folder}/") : bisect_left(paths, f"{folder}0")]


def with_libraries(
    folder: str, files: Mapping[str, str], paths: Sequence[str]
) -> tuple[dict[str, str], str]:
    """Return the origin of each file of a chart with its libraries, and a missing dependency.

    ``paths`` are the sorted paths of ``files``.
    """
    origins, missing, characters = dict[str, str](), "", 0
    waiting: list[tuple[str, tuple[str, ...]]] = [("", (folder,))]
    for prefix, line in waiting:  # line: the chart, and libraries that each need the next
        here = line[-1]
        for path in below(here, paths):
            origins[prefix + path[len(here) + 1 :]] = path
            characters += len(files[path])
        libraries = {needed.name: needed for needed in dependencies(here, files) if needed.folder}
        if (
            len(waiting) + len(libraries) > _MOST_LIBRARIES
            or len(origins) > _MOST_FILES
            or characters > _MOST_CHARACTERS
        ):
            message = (
                f"with its libraries, the chart has more than {_MOST_LIBRARIES} charts, "
                f"{_MOST_FILES:,} files or {_MOST_CHARACTERS:,} characters, counting a library "
                "once for each chart that needs it; take some out"
            )
            raise InvalidInput.at("dependencies", message, file=f"{folder}/Chart.yaml")
        for name, library in libraries.items():
            place = f"{prefix}charts/{name}/"
            origins = {at: path for at, path in origins.items() if not f"{at}/".startswith(place)}
            if library.folder in line:
                circle = " → ".join((*line[line.index(library.folder) :], library.folder))
                message = f"these charts need each other: {circle}; remove one of the dependencies"
                where = f"dependencies[{library.index}]"
                raise InvalidInput.at(where, message, file=f"{here}/Chart.yaml")
            waiting.append((place, (*line, str(library.folder))))
        for dependency in dependencies(here, files):
            copy = f"{prefix}charts/{dependency.name}/Chart.yaml"
            if not dependency.folder and copy not in origins:
                missing = missing or dependency.name
    archives = [
        fault(
            "",
            "is an archive, which hides what the chart has; unpack it (`tar -xzf`) into a folder "
            "of charts/, and remove it",
        ).within(path)
        for place, path in origins.items()
        if _ARCHIVE.search(place)
    ]
    if archives:
        raise InvalidInput(archives)
    return origins, missing


def defaults(folder: str, files: Mapping[str, str]) -> dict[str, Any]:
    imported: dict[str, Any] = {}
    for dependency in dependencies(folder, files):
        if dependency.folder and dependency.imports:
            exports = _values(dependency.folder, files).get("exports")
            for name in dependency.imports:
                values = exports.get(name) if isinstance(exports, dict) else None
                # as in Helm, the first import of a value counts
                imported = merged(values if isinstance(values, dict) else {}, imported)
    return _without_nulls(merged(imported, _values(folder, files)))


def takes_parameters(folder: str, files: Mapping[str, str]) -> bool:
    # whether its `parameters` are those of ROS nodes, as with a library that can reconfigure them
    return any(
        needed.name == LIBRARY and "reconfigure:" in files.get(f"{needed.folder}/values.yaml", "")
        for needed in dependencies(folder, files)
    )


def merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    # by Helm's rules: null removes what is below it, and stays where nothing is
    result = dict(below)
    for key, value in above.items():
        if value is None and key in result:
            del result[key]
        elif isinstance(value, dict) and isinstance(result.get(key), dict):
            result[key] = merged(result[key], value)
        else:
            result[key] = value
    return result


def _without_nulls(values: Mapping[str, Any]) -> dict[str, Any]:
    return {
        key: _without_nulls(value) if isinstance(value, dict) else value
        for key, value in values.items()
        if value is not None
    }


def overridden(values: Any, patch: Mapping[str, Any], below: Any) -> dict[str, Any]:  # noqa: ANN401
    """Return Helm values with an override's merge patch (RFC 7386); null removes a key.

    Over a default of the chart in ``below``, null stays, because only so Helm removes the default.
    So it does if ``below`` is None: what the chart has is not known.
    """
    result = dict(values) if isinstance(values, Mapping) else {}
    for key, value in patch.items():
        default = below.get(key, {}) if isinstance(below, Mapping) else below
        if isinstance(value, Mapping):
            inner = result.get(key)
            if key in result and inner is None and isinstance(default, Mapping):
                # another override removed all defaults, and this one brings none of them back
                inner = dict.fromkeys(default)
            result[key] = overridden(inner, value, default)
        elif value is not None or below is None or (isinstance(below, Mapping) and key in below):
            result[key] = value
        else:
            result.pop(key, None)
    return result


def faults(folder: str, files: Mapping[str, str]) -> Iterator[Fault]:
    path = f"{folder}/Chart.yaml"
    for place, name in _metadata(folder, files.get(path, ""))[1]:
        message = f"{name} is not a name that Helm allows; use letters, digits, '-', '_' and '.'"
        yield fault(place, message).within(path)
    for dependency in dependencies(folder, files):
        if not dependency.repository.startswith(_LOCAL):
            continue
        library, place = dependency.folder, f"dependencies[{dependency.index}]"
        text = files.get(f"{library}/Chart.yaml") if library else None
        if text is None:
            wrong = "that folder is not in appdefs/"
            if library:
                wrong = f"'{library}/Chart.yaml' does not exist"
            message = (
                f"{quoted(dependency.repository)}: {wrong}; correct the path, which is relative to "
                "the chart's folder and must not lead out of appdefs/"
            )
            yield fault(f"{place}.repository", message).within(path)
            continue
        version = _mapping(text).get("version")
        if _EXACT.fullmatch(dependency.version) and dependency.version != version:
            has = f"is version {version}" if version else "has no readable version"
            message = f"requires {dependency.version}, but the library in {library} {has}; make "
            yield fault(f"{place}.version", f"{message}the versions equal").within(path)


@lru_cache(maxsize=4096)
def _metadata(folder: str, text: str) -> tuple[tuple[Dependency, ...], tuple[tuple[str, str], ...]]:
    metadata = _mapping(text)
    listed = metadata.get("dependencies")
    valid, wrong = list[Dependency](), list[tuple[str, str]]()
    if not _is_name(metadata.get("name", "unnamed")):
        wrong.append(("name", quoted(str(metadata["name"]))))
    for index, entry in enumerate(listed if isinstance(listed, list) else ()):
        if not isinstance(entry, dict):
            continue
        name, alias = entry.get("name"), entry.get("alias") or entry.get("name")
        names = {"name": name, "alias": alias}
        bad = [field for field, value in names.items() if not _is_name(value)]
        if bad:
            value = quoted(str(names[bad[0]]))
            wrong.append((f"dependencies[{index}].{bad[0]}", value))
            continue
        repository, imports = str(entry.get("repository") or ""), entry.get("import-values")
        path = posixpath.normpath(posixpath.join(folder, repository.removeprefix(_LOCAL)))
        # Flux fetches charts only from appdefs/
        is_fetched = repository.startswith(_LOCAL) and path.startswith("appdefs/")
        valid.append(
            Dependency(
                index,
                str(name),
                str(alias),
                str(entry.get("version")),
                repository,
                path if is_fetched else None,
                tuple(map(str, imports)) if isinstance(imports, list) else (),
                bool(entry.get("condition") or entry.get("tags")),
            )
        )
    return tuple(valid), tuple(wrong)


def _is_name(value: object) -> bool:
    return isinstance(value, str) and _NAME.fullmatch(value) is not None


def _values(folder: str, files: Mapping[str, str]) -> dict[str, Any]:
    file = f"{folder}/values.yaml"
    try:
        return _read(files.get(file, ""))
    except InvalidInput as error:
        raise InvalidInput(strict_yaml.faults_in(error, file)) from None


def _mapping(text: str) -> dict[str, Any]:
    try:
        return _read(text)
    except InvalidInput:  # cross_check reports it for the charts of the registry
        return {}


@lru_cache(maxsize=256)
def _read(text: str) -> dict[str, Any]:
    values = strict_yaml.load(text)
    return values if isinstance(values, dict) else {}


# ---- the descriptions of a chart's values: comments of ``values.yaml``, as helm-docs has them ----
#
# A description starts with ``# --`` above its value and goes on in the comment lines that follow.

_KEY = re.compile(r"( *)([A-Za-z0-9_./-]+):(?: |$)")


def descriptions(text: str) -> dict[str, str]:
    described: dict[str, str] = {}
    path: list[tuple[int, str]] = []
    words: list[str] = []
    for line in text.splitlines():
        comment = line.strip()
        if comment.startswith("# -- "):
            words = [comment.removeprefix("# -- ")]
        elif comment.startswith("# ") and words:
            words.append(comment.removeprefix("# "))
        elif key := _KEY.match(line):
            indent = len(key[1])
            path = [*(step for step in path if step[0] < indent), (indent, key[2])]
            if words:
                described[".".join(name for _, name in path)] = " ".join(words)
            words = []
        else:
            words = []
    return described


# ---- the ``values.schema.json`` of a chart ----
#
# Neither Helm nor the generator follows a reference to another schema file. So this module copies
# the library's schema into the chart's schema.

LIBRARY = "ros-service"
EXPORT = "service"


def composed(
    title: str, own: Mapping[str, Any], values: str, library: Mapping[str, Any], shared: str
) -> dict[str, Any]:
    """Return the schema of a chart, including the library's values and all descriptions.

    ``own`` has the chart's properties that the library lacks or defines differently.
    """
    prefix = f"exports.{EXPORT}."
    words = {
        path.removeprefix(prefix): description
        for path, description in descriptions(shared).items()
        if path.startswith(prefix)
    } | descriptions(values)
    properties = {**library["definitions"][EXPORT]["properties"], **own}
    definitions = {name: s for name, s in library["definitions"].items() if name != EXPORT}
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": title,
        "type": "object",
        "additionalProperties": False,
        # `helm lint` lacks imported values, so the schema requires only the chart's own values.
        "required": sorted(own),
        "properties": {
            name: _described(copy.deepcopy(schema), name, words)
            for name, schema in sorted(properties.items())
        }
        # Helm adds these keys: one for the library's own values, and one for the global values.
        | {name: {"type": "object"} for name in (LIBRARY, "global")},
        "definitions": definitions,
    }


def _described(schema: dict[str, Any], path: str, words: Mapping[str, str]) -> dict[str, Any]:
    for name, inner in schema.get("properties", {}).items():
        schema["properties"][name] = _described(inner, f"{path}.{name}", words)
    return {**schema, "description": words[path]} if path in words else schema
