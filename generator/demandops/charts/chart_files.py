"""Charts in folders of the state repo: the libraries that they depend on, and their default values.

Pure: functions take the files as a mapping of paths to texts, and a chart as the path of its
folder. Like Flux and Argo CD, this module reads a library from the folder that ``repository:
file://…`` in ``Chart.yaml`` names. The folder must be in ``appdefs/``.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from demandops import strict_yaml
from demandops.errors import Fault, InvalidInput, fault
from demandops.quoting import quoted

_LOCAL = "file://"
_EXACT = re.compile(r"\d+\.\d+\.\d+")


@dataclass(frozen=True, slots=True)
class Dependency:
    """An entry of a chart's ``dependencies``.

    ``index`` is the entry's place in the list. ``folder`` is the folder in ``appdefs/`` that
    ``repository`` names, or None if it names no such folder. The folder may be missing in the state
    repo. ``imports`` lists those names in the library's ``exports`` whose values the chart imports.
    """

    index: int
    name: str
    version: str
    repository: str
    folder: str | None
    imports: tuple[str, ...]


def dependencies(folder: str, files: Mapping[str, str]) -> tuple[Dependency, ...]:
    """Return the dependencies of a chart; empty if its ``Chart.yaml`` cannot be read."""
    return _dependencies(folder, files.get(f"{folder}/Chart.yaml", ""))


def folders(folder: str, files: Mapping[str, str]) -> tuple[str, ...]:
    """Return the folders of a chart and of the libraries that it needs, directly or indirectly.

    Only libraries with a :attr:`Dependency.folder` are included, even if the folder is missing.
    """
    found = [folder]
    for one in found:
        for dependency in dependencies(one, files):
            if dependency.folder and dependency.folder not in found:
                found.append(dependency.folder)
    return tuple(found)


def defaults(folder: str, files: Mapping[str, str]) -> dict[str, Any]:
    """Return the default values of a chart.

    These are the chart's own values, merged by Helm's rules over the values that it imports by name
    from libraries in the state repo. A missing ``values.yaml`` has no values.

    Raises:
        InvalidInput: if a ``values.yaml`` is not valid YAML.
    """
    imported: dict[str, Any] = {}
    for dependency in dependencies(folder, files):
        if dependency.folder and dependency.imports:
            exports = _values(dependency.folder, files).get("exports")
            for name in dependency.imports:
                values = exports.get(name) if isinstance(exports, dict) else None
                more = merged({}, values if isinstance(values, dict) else {})
                imported = merged(more, imported)  # as in Helm, the first import of a value counts
    return merged(imported, _values(folder, files))


def merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values ``above`` merged over the values ``below`` by Helm's rules.

    Mappings are merged key by key. A null in ``above`` removes the key. Any other value in
    ``above`` replaces the value in ``below``.
    """
    result = dict(below)
    for key, value in above.items():
        if value is None:
            result.pop(key, None)
        elif isinstance(value, dict) and isinstance(result.get(key), dict):
            result[key] = merged(result[key], value)
        else:
            result[key] = value
    return result


def merge_patch(target: Any, patch: Any) -> Any:  # noqa: ANN401 - any JSON
    """Return ``target`` with a JSON merge patch (RFC 7386) applied; null removes a key."""
    if not isinstance(patch, Mapping):
        return patch
    result = dict(target) if isinstance(target, Mapping) else {}
    for key, value in patch.items():
        if value is None:
            result.pop(key, None)
        else:
            result[key] = merge_patch(result.get(key), value)
    return result


def faults(folder: str, files: Mapping[str, str]) -> Iterator[Fault]:
    """Yield a fault for each library that is not in the folder which ``file://…`` names for it.

    Also yield a fault if the chart requires an exact version and the library has another version.
    Libraries with another kind of ``repository`` are not checked.
    """
    for one in dependencies(folder, files):
        if not one.repository.startswith(_LOCAL):
            continue
        place = f"dependencies[{one.index}]"
        text = files.get(f"{one.folder}/Chart.yaml") if one.folder else None
        if text is None:
            wrong = (
                f"'{one.folder}/Chart.yaml' does not exist"
                if one.folder
                else "that folder is not in appdefs/"
            )
            message = (
                f"{quoted(one.repository)}: {wrong}; correct the path, which is relative to "
                "the chart's folder and must not lead out of appdefs/"
            )
            yield fault(f"{place}.repository", message).within(f"{folder}/Chart.yaml")
            continue
        version = _mapping(text).get("version")
        if _EXACT.fullmatch(one.version) and one.version != version:
            has = f"is version {version}" if version else "has no readable version"
            message = (
                f"requires {one.version}, but the library in {one.folder} {has}; make the versions "
                "equal"
            )
            yield fault(f"{place}.version", message).within(f"{folder}/Chart.yaml")


@lru_cache(maxsize=256)
def _dependencies(folder: str, text: str) -> tuple[Dependency, ...]:
    listed = _mapping(text).get("dependencies")
    return tuple(
        Dependency(
            index,
            str(one.get("name")),
            str(one.get("version")),
            str(one.get("repository") or ""),
            _local_folder(folder, str(one.get("repository") or "")),
            _imports(one.get("import-values")),
        )
        for index, one in enumerate(listed if isinstance(listed, list) else ())
        if isinstance(one, dict)
    )


def _imports(listed: object) -> tuple[str, ...]:
    return tuple(map(str, listed)) if isinstance(listed, list) else ()


def _local_folder(folder: str, repository: str) -> str | None:
    """Return the folder of a library in the state repo; None if it is not in ``appdefs/``.

    Flux fetches charts only from ``appdefs/``.
    """
    if not repository.startswith(_LOCAL):
        return None
    path = posixpath.normpath(posixpath.join(folder, repository.removeprefix(_LOCAL)))
    return path if path.startswith("appdefs/") else None


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
