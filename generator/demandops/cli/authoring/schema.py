"""``demandops schema``, and what it says of each property."""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path
from typing import Any

import click
from pydantic import BaseModel

from demandops.base import strict_yaml
from demandops.base.settings import API_VERSION, data_folder
from demandops.cli.output import say
from demandops.cli.target import ContextsFile
from demandops.cluster.clusters_file import AccessFile
from demandops.detect.rule_file import RuleFile
from demandops.model.config.appdef import ApplicationDefinition, ServiceDefinition
from demandops.model.config.inventory import BrokersFile, ClustersFile, NodesFile
from demandops.model.config.override import OverrideFile
from demandops.model.config.policy import AccessDomainsFile
from demandops.model.config.registry import ChartsFile, ClientsFile, ImagesFile, VersionsFile
from demandops.model.config.repo_settings import RepoSettings
from demandops.model.demand.goals import DemandGoal, WireGoal

# ---- a description and an example of each property, for editors and the docs ----

_COMMON = {
    "apiVersion": ["Version of the format", API_VERSION],
    "kind": ["Type of the file's content"],
}


def describe(schema: dict[str, Any], root: str) -> None:
    # by ``templates/schemas/properties.yaml``; ``root`` is the name of the model of the schema
    properties = _properties()
    for model, part in {root: schema, **schema.get("$defs", {})}.items():
        for name, field in part.get("properties", {}).items():
            # for the model in this schema, else for the model, else for the one it inherits from
            places = (f"{root}/{model}", model, properties["inherits"].get(model, ""))
            models = (*(properties.get(place) or {} for place in places), _COMMON)
            if entry := next((each[name] for each in models if name in each), None):
                description, *example = entry
                field["description"] = description
                only = (
                    [part["const"]] if "const" in part else part.get("enum", [True])[-1:]
                    for part in (field, *field.get("anyOf", ()))
                    if "const" in part or "enum" in part or part.get("type") == "boolean"
                )
                field["examples"] = example or next(only, [])


@lru_cache(maxsize=1)
def _properties() -> dict[str, Any]:
    file = data_folder("templates") / "schemas" / "properties.yaml"
    properties: dict[str, Any] = strict_yaml.load(file.read_text(encoding="utf-8"), file.name)
    return properties


# ---- ``demandops schema``: JSON Schemas of the files that people write ----

SCHEMAS: dict[str, tuple[type[BaseModel], str]] = {
    "access-domains": (
        AccessDomainsFile,
        "policy/access-domains.yaml, policy/access-domains/*.yaml",
    ),
    "cluster-access": (AccessFile, "the file of `demandops serve --clusters`"),
    "application": (ApplicationDefinition, "appdefs/<name>/appdef.yaml"),
    "brokers": (BrokersFile, "inventory/brokers.yaml, inventory/brokers/*.yaml"),
    "charts": (ChartsFile, "registry/charts.yaml, registry/charts/*.yaml"),
    "clusters": (ClustersFile, "inventory/clusters.yaml, inventory/clusters/*.yaml"),
    "contexts": (ContextsFile, "~/.config/demandops/contexts.yaml"),
    "demand": (DemandGoal, "a demand, for `demandops demand`"),
    "deployment-request": (WireGoal, "a goal of DeploymentRequest, for `demandops demand`"),
    "detector-rules": (RuleFile, "the file of `demandops detect`"),
    "images": (ImagesFile, "registry/images.yaml, registry/images/*.yaml"),
    "clients": (ClientsFile, "registry/clients.yaml, registry/clients/*.yaml"),
    "nodes": (NodesFile, "inventory/nodes.yaml, inventory/nodes/*.yaml"),
    "override": (OverrideFile, "overrides/<name>.yaml"),
    "service": (ServiceDefinition, "appdefs/<name>/service.yaml"),
    "state-repo": (RepoSettings, "demandops.yaml"),
    "versions": (VersionsFile, "registry/versions.yaml, registry/versions/*.yaml"),
}


@click.command()
@click.argument("name", required=False, type=click.Choice(sorted(SCHEMAS)), metavar="[NAME]")
@click.option(
    "--write",
    "folder",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Write all schemas to this folder, as <name>.json.",
)
def schema(name: str | None, folder: Path | None) -> None:
    """Without NAME, list the schemas. With a schema, an editor checks and completes files. For VS
    Code and its YAML extension, begin a file with `# yaml-language-server: $schema=…/nodes.json`.

    \b
    Examples:
      demandops schema
      demandops schema override
      demandops schema --write schemas
    """
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        for kind in SCHEMAS:
            folder.joinpath(f"{kind}.json").write_text(text(kind))
        say(f"{len(SCHEMAS)} schemas in {folder}")
    elif name is None:
        for kind, (_, file) in SCHEMAS.items():
            say(f"{kind:20} {file}")
    else:
        click.echo(text(name), nl=False)


def text(name: str) -> str:
    model, file = SCHEMAS[name]
    generated: dict[str, Any] = model.model_json_schema(by_alias=True)
    describe(generated, model.__name__)
    if model in (NodesFile, BrokersFile):
        generated = _with_placeholders(generated)
    dialect = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": file}
    return json.dumps({**dialect, **generated, "title": file}, indent=2, ensure_ascii=False) + "\n"


def _with_placeholders(part: Any) -> Any:  # noqa: ANN401 - any part of a schema
    """Allow a text with a placeholder where an entry whose id is a pattern may have one."""
    if isinstance(part, list):
        return [_with_placeholders(each) for each in part]
    if not isinstance(part, dict):
        return part
    if part.get("type") in ("integer", "number") or isinstance(part.get("pattern"), str):
        told = {key: part[key] for key in ("title", "description", "examples") if key in part}
        value = {key: part[key] for key in part if key not in told}
        text = {"type": "string", "pattern": r"\{[A-Za-z_][A-Za-z0-9_]*\}"}
        return told | {"anyOf": [value, text]}
    return {key: _with_placeholders(value) for key, value in part.items()}
