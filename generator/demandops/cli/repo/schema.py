"""``demandops schema``: JSON Schemas of the files that people write."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click
from pydantic import BaseModel

from demandops.cli.contexts import ContextsFile
from demandops.cli.output import console
from demandops.cli.repo.schema_properties import describe
from demandops.cluster.clusters_file import AccessFile
from demandops.config.appdef import ApplicationDefinition, ServiceDefinition
from demandops.config.inventory import BrokersFile, ClustersFile, NodesFile
from demandops.config.override import OverrideFile
from demandops.config.policy import AccessDomainsFile
from demandops.config.registry import ChartsFile, ClientsFile, ImagesFile, VersionsFile
from demandops.config.repo_settings import RepoSettings
from demandops.demand.demand_goal import DemandGoal
from demandops.demand.deployment_request_goal import WireGoal
from demandops.detection.rules.rule_file import RuleFile

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
    "demand": (DemandGoal, "a demand, for `demandops demand` and `demandops request`"),
    "deployment-request": (WireGoal, "a goal of DeploymentRequest, for `demandops request`"),
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
    """Print the JSON Schema of a kind of file.

    Without NAME, list the schemas. With a schema, an editor checks and completes files. For VS Code
    and its YAML extension, begin a file with `# yaml-language-server: $schema=…/nodes.json`.

    \b
    Examples:
      demandops schema
      demandops schema override
      demandops schema --write schemas
    """
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        for each in SCHEMAS:
            folder.joinpath(f"{each}.json").write_text(text(each))
        console().print(f"{len(SCHEMAS)} schemas in {folder}")
    elif name is None:
        for each, (_, file) in SCHEMAS.items():
            console().print(f"{each:20} {file}")
    else:
        click.echo(text(name), nl=False)


def text(name: str) -> str:
    model, file = SCHEMAS[name]
    generated: dict[str, Any] = model.model_json_schema(by_alias=True)
    describe(generated, model.__name__)
    dialect = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": file}
    return json.dumps({**dialect, **generated, "title": file}, indent=2, ensure_ascii=False) + "\n"
