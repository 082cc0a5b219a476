"""What ``demandops new`` lays down: YAML files, images with pipelines, and applications. Pure."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from demandops.base import strict_yaml
from demandops.base.addresses import as_git_url
from demandops.base.errors import InvalidInput
from demandops.base.naming import PATTERN_WORDS
from demandops.base.quoting import quoted
from demandops.base.settings import API_VERSION, modeline
from demandops.connections.connection_types import CONNECTION_TYPES
from demandops.model.config.config import Config
from demandops.model.config.policy import AccessDomain, Rule, matches
from demandops.model.config.registry import Image
from demandops.templating import charts

# ---- the text of YAML files that people edit ----


def document(path: str, schema: str, kind: str, fields: Mapping[str, Any], note: str = "") -> str:
    text = strict_yaml.dump({"apiVersion": API_VERSION, "kind": kind, **fields})
    comment = "".join(f"# {line}\n" for line in note.splitlines())
    return modeline(path, schema) + comment + text


# ---- a container file and pipelines for a ROS package ----

_PATHS = {
    "Containerfile": "Containerfile",
    "github-workflow.yml": ".github/workflows/image.yml",
    "gitlab-ci.yml": ".gitlab-ci.yml",
    "propose-image": "ci/propose-image",
}
# The templates put these values into YAML and shell scripts as they are, so no character of them
# may need quotes.
_IMAGE_NAME = re.compile(r"[a-z0-9]([-a-z0-9]{0,61}[a-z0-9])?")
_REPOSITORY = re.compile(r"(?P<host>[a-z0-9.-]+(:[0-9]+)?)(/[a-z0-9._-]+)+")
_URL = re.compile(r"(https|ssh)://([A-Za-z0-9._-]+@)?[A-Za-z0-9.-]+(:[0-9]+)?/[A-Za-z0-9._~/-]+")


def image_files(
    name: str, repository: str, state_repo: str, texts: Mapping[str, str]
) -> dict[str, str]:
    # by path; ``texts`` has the files in ``templates/scaffold/image`` by name
    url, image = as_git_url(state_repo), _REPOSITORY.fullmatch(repository)
    if not _IMAGE_NAME.fullmatch(name):
        message = (
            f"{quoted(name)} is no valid name; use at most 63 of a-z, 0-9 and -, and no - at its "
            "ends"
        )
        raise InvalidInput.at("NAME", message)
    if image is None:
        message = (
            f"{quoted(repository)} is no valid repository; write HOST/PATH in lower case, without "
            "a tag"
        )
        raise InvalidInput.at("--repository", message)
    if not _URL.fullmatch(url):
        message = f"{quoted(state_repo)} is no valid URL; write https://HOST/PATH or git@HOST:PATH"
        raise InvalidInput.at("--state-repo", message)
    given = {"NAME": name, "REPOSITORY": repository, "HOST": image["host"], "STATE_REPO": url}
    return {_PATHS[file]: _filled(text, given) for file, text in texts.items()}


def _filled(text: str, given: Mapping[str, str]) -> str:
    return re.sub("@([A-Z_]+)@", lambda match: given[match[1]], text)


# ---- a new application ----
#
# The application's services form a chain: the first service reads the application's inputs, and
# each further service reads the outputs of the service before it. One image contains the launch
# files of all services.

LIBRARY_FOLDER = f"appdefs/charts/{charts.LIBRARY}"
_NAME = re.compile(r"^[a-z0-9]([-a-z0-9]*[a-z0-9])?$")
_RESULT = "result"
_VERSION = "0.1.0"


@dataclass(frozen=True, slots=True)
class ServicePlan:
    name: str
    package: str
    launch_file: str


@dataclass(frozen=True, slots=True)
class ApplicationPlan:
    name: str
    description: str
    inputs: Mapping[str, str]  # the message type of each input
    services: tuple[ServicePlan, ...]
    image: Image
    node: str  # of the example demand


def refuse_name(name: str, config: Config) -> None:
    if not _NAME.fullmatch(name):
        raise InvalidInput.at(
            "NAME", f"{quoted(name)} cannot be used here; write {PATTERN_WORDS[_NAME.pattern]}"
        )
    if name in config.appdefs or name in config.charts or name in config.images:
        raise InvalidInput.at("NAME", f"'{name}' exists already; choose another name")


def application_files(
    plan: ApplicationPlan, config: Config, library: Mapping[str, str], texts: Mapping[str, str]
) -> dict[str, str]:
    # by path, with those of the library chart, ``library``, if the state repo lacks it; ``texts``
    # has the files in ``templates/scaffold/application`` by name
    has_library = f"{LIBRARY_FOLDER}/Chart.yaml" in config.files
    shared = config.files if has_library else library
    version = re.search(r"(?m)^version: (\S+)$", shared[f"{LIBRARY_FOLDER}/Chart.yaml"])
    given = {
        "NAME": plan.name,
        "DESCRIPTION": plan.description,
        "PACKAGE": plan.services[0].package,
        "FILE": plan.services[0].launch_file,
        "REPOSITORY": plan.image.repository,
        "RESULT": _RESULT,
        "VERSION": _VERSION,
        "LIBRARY": charts.LIBRARY,
        "LIBRARY_FOLDER": LIBRARY_FOLDER,
        "LIBRARY_VERSION": version[1] if version else _VERSION,
        "EXPORT": charts.EXPORT,
        "SERVICES": "".join(
            f"| `{service.name}` | `ros2 launch {service.package} {service.launch_file}` "
            f"| {', '.join(f'`{source}`' for source in inputs.values())} |\n"
            for service, inputs in _chain(plan)
        ),
    }
    values = _filled(texts["chart-values.yaml"], given)
    schema = charts.composed(
        f"Values of the chart {plan.name}",
        {"launch": json.loads(texts["launch.schema.json"])},
        values,
        json.loads(shared[f"{LIBRARY_FOLDER}/values.schema.json"]),
        shared[f"{LIBRARY_FOLDER}/values.yaml"],
    )
    root = f"appdefs/{plan.name}"
    chart = f"{root}/charts/{plan.name}"
    files = {
        f"{root}/appdef.yaml": _appdef(plan, config),
        f"{root}/README.md": _filled(texts["readme"], given),
        f"{root}/demand.yaml": _demand(plan, config),
        f"{chart}/Chart.yaml": _filled(texts["chart.yaml"], given),
        f"{chart}/values.yaml": values,
        f"{chart}/values.schema.json": json.dumps(schema, indent=2, ensure_ascii=False) + "\n",
        f"{chart}/README.md": _filled(texts["chart-readme"], given),
        f"{chart}/templates/service.yaml": _filled(texts["service.yaml"], given),
    }
    for service, inputs in _chain(plan):
        topics = (f'    {role}_topics: {{{{ topics.{role} | join(",") }}}}\n' for role in inputs)
        own = {"SERVICE": service.name, "PACKAGE": service.package, "FILE": service.launch_file}
        own["TOPICS"] = "".join(topics)
        path = f"{root}/values/{service.name}.yaml.j2"
        files[path] = _filled(texts["values.yaml.j2"], given | own)
    for kind, content in (
        ("charts", {"folder": chart, "version": _VERSION}),
        ("images", plan.image.model_dump(exclude_none=True)),
    ):
        path = f"registry/{kind}/{plan.name}.yaml"
        files[path] = document(path, kind, kind.title(), {kind: {plan.name: content}})
    return files if has_library else files | dict(library)


def _chain(plan: ApplicationPlan) -> Iterable[tuple[ServicePlan, dict[str, str]]]:
    inputs = {role: role for role in plan.inputs}  # the source of each input
    for service in plan.services:
        yield service, inputs
        inputs = {_role(service.name): f"{service.name}.{_RESULT}"}


def _role(name: str) -> str:
    return name.replace("-", "_")


def _appdef(plan: ApplicationPlan, config: Config) -> str:
    # Names of releases begin with the prefix of their service, so each service needs its own.
    taken = {kind.word for kind in CONNECTION_TYPES}
    taken |= {service.prefix for own in config.services.values() for service in own.values()}
    taken |= {definition.prefix for definition in config.definitions.values()}
    services: dict[str, Any] = {}
    for service, inputs in _chain(plan):
        role, letters = _role(service.name), re.sub("[^a-z0-9]", "", service.name)[:8]
        prefixes = (letters, *(f"{letters}{number}" for number in range(2, 100)))
        prefix = next(word for word in prefixes if word not in taken)
        taken.add(prefix)
        services[service.name] = {
            "prefix": prefix,
            "inputs": inputs,
            "outputs": {_RESULT: f"/{{instance}}_{role}"},
            "chart": plan.name,
            "images": [plan.name],
            "values": f"values/{service.name}.yaml.j2",
        }
    fields = {
        "name": plan.name,
        "description": plan.description,
        "inputs": {role: {"type": type} for role, type in plan.inputs.items()},
        "services": services,
    }
    note = (
        "docs/appdef.md of DemandOps explains each field. To run a service once for each topic of\n"
        "an input instead of once for each application, add `each: <input>` to it."
    )
    path = f"appdefs/{plan.name}/appdef.yaml"
    return document(path, "application", "ApplicationDefinition", fields, note)


def _rules_for(plan: ApplicationPlan, config: Config) -> tuple[Rule, ...]:
    domain = config.domain_of.get(plan.node)
    return tuple(
        rule
        for rule in (domain.rules if domain else ())
        if matches(plan.name, rule.applications) and matches(plan.node, rule.nodes)
    )


def closed_domain(plan: ApplicationPlan, config: Config) -> AccessDomain | None:
    """Return the access domain whose rules refuse the example demand; None if none does."""
    domain = config.domain_of.get(plan.node)
    return domain if domain and domain.rules and not _rules_for(plan, config) else None


def _demand(plan: ApplicationPlan, config: Config) -> str:
    node, domain = config.nodes.get(plan.node), config.domain_of.get(plan.node)
    topics = node.topics if node else {}
    # The requester matches a rule that allows the application. If there is none, it matches the
    # first rule, and a person must widen the rules (`closed_domain`).
    rules = _rules_for(plan, config) or (domain.rules[:1] if domain else ())
    requester = "operator"
    if rules:
        pattern = rules[0].requesters[0]
        matching = next((id for id in sorted(config.nodes) if matches(id, (pattern,))), "")
        if pattern.strip("*"):
            requester = matching or pattern.replace("?", "1").replace("*", "")
    fields = {
        "demand": f"{plan.name}-example",
        "requesters": [requester],
        "applications": [
            {
                "id": f"{plan.node}/{plan.name}",
                "type": plan.name,
                "node": plan.node,
                "inputs": {
                    role: [{"topic": topics.get(role, f"/{role}"), "source": plan.node}]
                    for role in plan.inputs
                },
            }
        ],
    }
    path = f"appdefs/{plan.name}/demand.yaml"
    note = (
        f"An example: demandops request {path}\n"
        "`requesters` lists who demands this, by names that the rules of the access domain allow."
    )
    return document(path, "demand", "Demand", fields, note)
