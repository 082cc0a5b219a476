"""A release as a file, and the last check of files before a commit."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache
from importlib.util import find_spec
from itertools import dropwhile
from pathlib import Path
from typing import Any

import jsonschema_rs

from demandops.base import strict_yaml
from demandops.base.errors import Fault, InvalidInput, fault, field_path
from demandops.model.config.config import Config
from demandops.model.config.override import Override, format_time
from demandops.model.ledger.ledger import World
from demandops.model.release import Release
from demandops.render import manifests
from demandops.render.gitops import CLUSTERS_ROOT
from demandops.templating.values import Evaluate

# ---- the last check of rendered files before a commit ----
#
# Objects of Kubernetes' built-in kinds must match the schemas of Kubernetes. Every path must be in
# a folder that the generator owns. No two objects of a cluster may have the same kind, namespace
# and name.

# whose schemas check the objects of built-in kinds
KUBERNETES_VERSION = "1.36.0"

OWN_ROOTS = ("bootstrap/", "clusters/", "ledger/")

_BUILT_IN = frozenset(
    {
        "v1",
        "admissionregistration.k8s.io/v1",
        "apps/v1",
        "networking.k8s.io/v1",
        "rbac.authorization.k8s.io/v1",
    }
)
_API = re.compile(r"^apiVersion: (\S+)$", re.MULTILINE)


def check_files(
    files: Mapping[str, str | None], checkpoint: Callable[[], None] = lambda: None
) -> None:
    """Raise InvalidInput for a mistake in DemandOps or a template; ``None`` removes a file."""
    faults: list[Fault] = []
    seen: dict[tuple[str, str, str, str], str] = {}
    for path, text in sorted(files.items()):
        checkpoint()
        if not path.startswith(OWN_ROOTS) or ".." in path.split("/"):
            message = "is in no folder that the generator writes; report this bug"
            faults.append(fault("", message).within(path))
        if text is None or path.startswith("ledger/"):
            continue
        for document in _documents(path, text, faults):
            metadata = document.get("metadata") or {}
            api, kind = str(document.get("apiVersion")), str(document.get("kind"))
            name = str(metadata.get("name"))
            cluster = path.split("/")[1].removesuffix(".yaml")
            identity = (cluster, kind, str(metadata.get("namespace")), name)
            other = seen.get(identity)
            if other is not None:
                where = "twice in this file" if other == path else f"in {other} too"
                faults.append(fault("metadata.name", f"{kind} {name} is {where}").within(path))
            seen[identity] = path
            errors = _kind_validator(api, kind).iter_errors(document) if api in _BUILT_IN else ()
            for error in errors:
                place = field_path(tuple(error.instance_path))
                faults.append(fault(place, error.message).within(path))
    if faults:
        raise InvalidInput(faults)


def _documents(path: str, text: str, faults: list[Fault]) -> Iterator[dict[str, Any]]:
    for part in text.split("\n---\n"):
        # The spec of a document for Flux or Argo CD is not parsed, because nothing reads it here. A
        # template of the program writes it, and Helm values were checked when they were computed.
        api = _API.search(part)
        of_controller = api is not None and api[1] not in _BUILT_IN
        try:
            document = strict_yaml.load(part.partition("\nspec:\n")[0] if of_controller else part)
        except InvalidInput as error:
            faults += strict_yaml.faults_in(error, path)
            continue
        if isinstance(document, dict):
            yield document
        else:
            faults.append(
                fault("", "has a document that is not a mapping; fix its template").within(path)
            )


@lru_cache(maxsize=64)
def _kind_validator(api: str, kind: str) -> Any:  # noqa: ANN401
    *group, version = api.split("/")
    prefix = f"{group[0].split('.')[0]}-" if group else ""
    package = find_spec("kubernetes_validate")  # only its files are used; an import is slow
    assert package and package.origin  # noqa: S101 - it is one of our dependencies
    folder = Path(package.origin).parent / "kubernetes-json-schema"
    folder = folder / f"v{KUBERNETES_VERSION}-local-strict"
    name = f"{kind.lower()}-{prefix}{version}.json"
    schema = _with_local_references(folder / name)
    definitions = _with_local_references(folder / "_definitions.json")["$defs"]
    return jsonschema_rs.Draft7Validator({**schema, "$defs": definitions})


@lru_cache(maxsize=64)  # each kind needs the definitions, which are large
def _with_local_references(file: Path) -> dict[str, Any]:
    # the definitions are put into each schema, because no file is at the path that it refers to
    text = file.read_text().replace("/api/_definitions.json#/$defs/", "#/$defs/")
    schema: dict[str, Any] = json.loads(text)
    return schema


# ---- the file of a release: comment lines that name the overrides, then the rendered body ----
#
# A ``hold`` override keeps the body of a file byte for byte. Only the comments above the body may
# change. These comments still name the overrides that shaped the body when the hold started.

_START = "# override overrides/"
# these effects change only a release's comments, which are updated even in a held file
_OUTSIDE_BODY = frozenset({"hold", "keep"})
_UPDATED_COMMENT = re.compile(rf"{_START}[^:]+: (\w+, )*(hold|keep)(, \w+)*; ")
_CHART = re.compile(rf"{CLUSTERS_ROOT}/[^/]+/[^/]+/_charts/[^/]+\.yaml")


def release_text(release: Release, config: Config, evaluate: Evaluate, current: str | None) -> str:
    shaping = release.shaping
    if not shaping.held:
        comments = [override_comment(override, effects) for override, effects in shaping.by]
        return _join(comments, manifests.render(release, config, evaluate))
    outside, of_body = list[str](), list[str]()
    for override, effects in shaping.by:
        comments = outside if _OUTSIDE_BODY & {*effects} else of_body
        comments.append(override_comment(override, effects))
    if current is None:
        return _join([*outside, *of_body], manifests.render(release, config, evaluate))
    lines = current.splitlines(keepends=True)
    body = list(dropwhile(lambda line: line.startswith(_START), lines))
    # overrides that shaped the body when the hold started may have ended, so their comments stay
    above = (line.rstrip("\n") for line in lines[: len(lines) - len(body)])
    frozen = [comment for comment in above if not _UPDATED_COMMENT.match(comment)]
    return _join([*outside, *frozen], "".join(body))


def _join(comments: list[str], body: str) -> str:
    return "".join(f"{comment}\n" for comment in comments) + body


def override_comment(override: Override, effects: tuple[str, ...]) -> str:
    until = f"until {format_time(override.end)}; " if override.end else ""
    return (
        f"# override {override.path}: {', '.join(effects)}; priority {override.priority}; {until}"
        f"owner {override.owner}; reason: {override.reason}"
    )


def kept_charts(
    files: Mapping[str, str], current: Mapping[str, str], world: World
) -> dict[str, str]:
    """Return the chart sources in ``current`` that stay for releases that are held."""
    if not any(override.hold for override in world.overrides):
        return {}
    # not that of a chart in a folder of the state repo: it would fetch the folder's newest version
    return {
        path: text
        for path, text in current.items()
        if _CHART.fullmatch(path) and path not in files and "kind: GitRepository" not in text
    }
