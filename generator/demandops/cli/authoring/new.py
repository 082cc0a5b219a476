"""``demandops new``: files for people to edit, valid from the start."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from demandops import __version__
from demandops.base import addresses, strict_yaml
from demandops.base.errors import InvalidInput, StateRepoError
from demandops.base.naming import PATTERN_WORDS
from demandops.base.quoting import quoted
from demandops.base.settings import data_folder
from demandops.cli.formats import output_option, show
from demandops.cli.output import busy, read_by
from demandops.connections.connection_types import CONNECTION_TYPES
from demandops.decide.state import State, try_configuration
from demandops.model.config.base_model import document, matches
from demandops.model.config.config import CONFIG_ROOTS, DOMAINS_FILE, Config
from demandops.model.config.load import load
from demandops.model.config.registry import Image
from demandops.model.ledger.ledger import Ledger
from demandops.repo import new_repo
from demandops.repo.git import tree as trees
from demandops.repo.merge_check import edited_checkout
from demandops.templating import charts
from demandops.templating.evaluator import EVALUATE

_directory = click.option(
    "--directory",
    "-C",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    default=Path(),
    metavar="DIR",
    help="Where to write: a checked-out repository. Default: this folder.",
)


@click.group()
def new() -> None:
    """The files in the state repo are valid as they are: `demandops check` passes. `new image`
    writes to the repository of a ROS package instead. The command changes no existing file and
    commits nothing.

    \b
    Examples:
      demandops new application tracking --input camera=sensor_msgs/msg/Image \\
        --service detector=my_package/detector --image ghcr.io/me/tracking:1.0
    """


def _write_files(directory: Path, files: Mapping[str, str], output: str, then: list[str]) -> None:
    if there := [path for path in files if (directory / path).exists()]:
        raise StateRepoError(f"{directory / there[0]} exists; move it away (nothing was changed)")
    for path, text in files.items():
        (directory / path).parent.mkdir(parents=True, exist_ok=True)
        (directory / path).write_text(text, encoding="utf-8")
    lines = [f"new: {directory / path}" for path in sorted(files)]
    show(output, {"files": sorted(files)}, [*lines, *then])


def _templates(what: str) -> dict[str, str]:
    folder = data_folder("templates") / "scaffold" / what
    return {path.name: path.read_text(encoding="utf-8") for path in sorted(folder.iterdir())}


def _filled(text: str, given: Mapping[str, str]) -> str:
    def write(match: re.Match[str]) -> str:
        before, value = match[1] or "", given[match[2]]
        # YAML reads some words, such as `on`, as no text
        is_text = not before or strict_yaml.plain_value(value) == value
        return before + (value if is_text else json.dumps(value))

    return re.sub("(?m)(: (?=@[A-Z_]+@$))?@([A-Z_]+)@", write, text)


# ---- ``new image``: a container file and pipelines for a ROS package ----

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


@new.command()
@click.argument("name")
@click.option(
    "--repository",
    required=True,
    metavar="HOST/PATH",
    help="The image's repository in a container registry, such as ghcr.io/me/cam.",
)
@click.option(
    "--state-repo",
    "state_repo",
    required=True,
    metavar="URL",
    help="The state repo to which the image is proposed.",
)
@_directory
@output_option
def image(name: str, repository: str, state_repo: str, directory: Path, output: str) -> None:
    """Write a container file and pipelines for a ROS package of your own.

    NAME is the image's name in registry/images/. The pipelines, for GitHub and GitLab, test the
    package. When you push a tag, they also build the image and propose it, with its digest, to the
    state repo.

    \b
    Examples:
      demandops new image cam --repository ghcr.io/me/cam --state-repo git@host:f
    """
    url, parts = addresses.as_git_url(state_repo), _REPOSITORY.fullmatch(repository)
    if not _IMAGE_NAME.fullmatch(name):
        message = "is no valid name; use at most 63 of a-z, 0-9 and -, and no - at its ends"
        raise InvalidInput.at("NAME", f"{quoted(name)} {message}")
    if parts is None:
        message = "is no valid repository; write HOST/PATH in lower case, without a tag"
        raise InvalidInput.at("--repository", f"{quoted(repository)} {message}")
    if not _URL.fullmatch(url):
        message = "is no valid URL; write https://HOST/PATH or git@HOST:PATH"
        raise InvalidInput.at("--state-repo", f"{quoted(state_repo)} {message}")
    given = {"NAME": name, "REPOSITORY": repository, "HOST": parts["host"], "STATE_REPO": url}
    files = {_PATHS[file]: _filled(text, given) for file, text in _templates("image").items()}
    then = ["keep .github/workflows/image.yml or .gitlab-ci.yml, whichever you need"]
    _write_files(directory, files, output, then)


# ---- ``new application`` ----
#
# The application's services form a chain: the first service reads the application's inputs, and
# each further service reads the outputs of the service before it. One image contains the nodes of
# all services. What demands decide of a node is a ROS parameter, and changes while the node runs.

_TYPE = re.compile(r"(?P<package>[A-Za-z]\w*)(/msg)?/(?P<name>[A-Za-z]\w*)", re.ASCII)
_SERVICE = re.compile(r"(?P<name>[^=]+)=(?P<package>[^/]+)/(?P<file>[^/]+)")


@dataclass(frozen=True, slots=True)
class _Service:
    name: str
    package: str
    executable: str

    @property
    def role(self) -> str:  # of its output, as the next service reads it
        return self.name.replace("-", "_")


def _input(text: str) -> tuple[str, str]:
    role, _, type = text.partition("=")
    if not (role and type):
        raise ValueError(f"'{text}' is not ROLE=TYPE; write it like camera=sensor_msgs/msg/Image")
    match = _TYPE.fullmatch(type)
    full = f"{match['package']}/msg/{match['name']}" if match else "package/msg/Name"
    if type != full:
        raise ValueError(f"'{text}' has no message type of ROS 2; write {role}={full}")
    return role, full


def _service(text: str) -> _Service:
    if not (match := _SERVICE.fullmatch(text)):
        example = "detector=my_package/detector"
        raise ValueError(f"'{text}' is not NAME=PACKAGE/FILE; write it like {example}")
    return _Service(match["name"], match["package"], match["file"])


def _image(text: str) -> Image:
    image = addresses.image(text)
    if not (image.tag or image.digest):
        raise ValueError(f"'{text}' has no tag or digest; write {text}:TAG")
    return Image(repository=image.name, tag=image.tag or None, digest=image.digest or None)


@new.command()
@click.argument("name")
@click.option(
    "--description", default="", metavar="TEXT", help="What the application does, in a sentence."
)
@click.option(
    "--input",
    "inputs",
    multiple=True,
    required=True,
    callback=read_by(_input),
    metavar="ROLE=TYPE",
    help="An input and its message type: camera=sensor_msgs/msg/Image. May be repeated.",
)
@click.option(
    "--service",
    "services",
    multiple=True,
    required=True,
    callback=read_by(_service),
    metavar="NAME=PACKAGE/FILE",
    help="A service and the executable or launch file of its node: detector=my_package/detector. "
    "May be repeated. Each further service reads the outputs of the service before it.",
)
@click.option(
    "--image",
    required=True,
    callback=read_by(_image),
    metavar="IMAGE",
    help="The image, with a tag or digest: ghcr.io/me/tracking:1.0.",
)
@click.option(
    "--node",
    default="",
    metavar="ID",
    help="The node of the example demand. Default: an edge server if there is one.",
)
@_directory
@output_option
def application(  # noqa: PLR0913 - as many as options
    name: str,
    *,
    description: str,
    inputs: tuple[tuple[str, str], ...],
    services: tuple[_Service, ...],
    image: Image,
    node: str,
    directory: Path,
    output: str,
) -> None:
    """Write a new application: definition, values, chart, registry, README, a node and a demand.

    Its nodes take new inputs, parameters and outputs while they run, as ROS parameters.

    \b
    Examples:
      demandops new application tracking --input camera=sensor_msgs/msg/Image \\
        --service detector=my_package/detector --image ghcr.io/me/tracking:1.0
    """
    with busy("reading the state repo"):
        with edited_checkout.opened(directory) as (_, tree):
            existing = trees.texts(tree, CONFIG_ROOTS)
        config = load(existing)
    if not _APPLICATION_NAME.fullmatch(name):
        words = PATTERN_WORDS[_APPLICATION_NAME.pattern]
        raise InvalidInput.at("NAME", f"{quoted(name)} cannot be used here; write {words}")
    if name in (*config.appdefs, *config.charts, *config.images, _SYNC):
        raise InvalidInput.at("NAME", f"'{name}' exists already; choose another name")
    roles, names = [role for role, _ in inputs], [service.name for service in services]
    for option, given in (("--input", roles), ("--service", names)):
        if twice := next((each for each in given if given.count(each) > 1), ""):
            raise InvalidInput.at(option, f"'{twice}' is there twice; choose another name")
    types = dict(inputs)
    # a demand can name only nodes in an access domain
    nodes = sorted(config.usable_nodes(), key=lambda id: (config.nodes[id].type != "edge", id))
    if not (node or nodes):
        message = "the inventory has no node in an access domain, so no demand can be made"
        raise StateRepoError(f"{message}; add one first, in inventory/nodes.yaml")
    node = node or nodes[0]
    description = description or f"Runs {', '.join(names)}"
    files = _application_files(name, description, types, services, image, config)
    path = f"appdefs/{name}/demand.yaml"
    files[path], is_allowed = _example_demand(path, name, types, node, config)
    if strange := [path for path in files if ".." in path.split("/") or "//" in path]:
        raise StateRepoError(f"{strange[0]} is not a valid file name; choose another name")
    # nothing is written unless the whole configuration is valid with it
    with busy("rendering an example of each application"):
        try_configuration(State(load({**existing, **files}), Ledger(), EVALUATE))
    then = [f"to check the files: demandops check {directory}"]
    if (sync := f"registry/images/{_SYNC}.yaml") in files:
        then.append(
            f"{sync} names the image of DemandOps, which sets the nodes' parameters; build it as "
            "docs/deployment.md says, or correct its name"
        )
    if not is_allowed:
        domain = config.domain_of[node]
        then.append(
            f"no rule of access domain '{domain.name}' allows demands for this application on "
            f"{node}; to allow them, widen a rule, such as '{domain.rules[0].name}', in "
            f"{config.file_of(DOMAINS_FILE, domain.name)}"
        )
    then.append(
        "when the files are on main, try the application: demandops demand --dry-run "
        f"{directory / path}"
    )
    _write_files(directory, files, output, then)


_APPLICATION_NAME = re.compile(r"^[a-z0-9]([-a-z0-9]*[a-z0-9])?$")
_RESULT = "result"
_VERSION = "0.1.0"
_LIBRARY_FOLDER = f"appdefs/charts/{charts.LIBRARY}"
_SYNC = "demandops"  # the image with `demandops parameter-sync`


def _version_of(files: Mapping[str, str], chart: str) -> str:
    version = re.search(r"(?m)^version: (\S+)$", files[f"{chart}/Chart.yaml"])
    return version[1] if version else _VERSION


def _application_files(
    name: str,
    description: str,
    types: Mapping[str, str],
    services: Sequence[_Service],
    image: Image,
    config: Config,
) -> dict[str, str]:
    root = f"appdefs/{name}"
    chart = f"{root}/charts/{name}"
    library, texts = new_repo.files_of_library(_LIBRARY_FOLDER), _templates("application")
    folder = _LIBRARY_FOLDER
    if '"reconfigure"' not in config.files.get(f"{folder}/values.schema.json", '"reconfigure"'):
        # an earlier version, which cannot change a running node, stays for the charts that use it
        folder += f"-{_version_of(library, folder)}"
        library = {folder + path.removeprefix(_LIBRARY_FOLDER): library[path] for path in library}
    has_library = f"{folder}/Chart.yaml" in config.files
    files, shared = ({}, config.files) if has_library else (library, library)
    given = {
        "NAME": name,
        "DESCRIPTION": description,
        "PACKAGE": services[0].package,
        "FILE": services[0].executable,
        "ROLE": services[0].role,
        "REPOSITORY": image.repository,
        "RESULT": _RESULT,
        "SYNC": _SYNC,
        "VERSION": _VERSION,
        "LIBRARY": charts.LIBRARY,
        "LIBRARY_FOLDER": folder,
        "LIBRARY_PLACE": folder.removeprefix("appdefs/"),
        "LIBRARY_VERSION": _version_of(shared, folder),
        "EXPORT": charts.EXPORT,
        "SERVICES": "",
    }
    # Names of releases begin with the prefix of their service, so each service needs its own.
    taken = {kind.word for kind in CONNECTION_TYPES}
    taken |= {service.prefix for own in config.services.values() for service in own.values()}
    taken |= {definition.prefix for definition in config.definitions.values()}
    inputs = {role: role for role in types}  # the origin of each input of the next service
    types_of = {**types}  # its message type
    definitions: dict[str, Any] = {}
    for service in services:
        letters = re.sub("[^a-z0-9]", "", service.name)[:8]
        prefixes = (letters, *(f"{letters}{number}" for number in range(2, 100)))
        prefix = next(word for word in prefixes if word not in taken)
        taken.add(prefix)
        definitions[service.name] = {
            "prefix": prefix,
            "inputs": inputs,
            "outputs": {_RESULT: f"/{{instance}}_{service.role}"},
            "live": ["parameters"],
            "chart": name,
            "images": [name, _SYNC],
            "values": f"values/{service.name}.yaml.j2",
        }
        given["SERVICES"] += (
            f"| `{service.name}` | `{service.executable}` of the ROS package `{service.package}` "
            f"| {', '.join(f'`{origin}`' for origin in inputs.values())} |\n"
        )
        parameters = {role: f"{role.replace('-', '_')}_topics" for role in inputs}
        modules = {role: type.replace("/", ".") for role, type in types_of.items()}
        packages = sorted({"rclpy", *(module.rpartition(".")[0] for module in modules.values())})
        own = {
            "SERVICE": service.name,
            "PACKAGE": service.package,
            "FILE": service.executable,
            "ROLE": service.role,
            "TOPICS": "".join(
                f'    {parameter}: {{{{ topics["{role}"] }}}}\n'
                for role, parameter in parameters.items()
            ),
            "IMPORTS": "\n".join(f"import {package}" for package in packages),
            "INPUTS": "\n".join(
                f'    "{parameter}": {modules[role]},' for role, parameter in parameters.items()
            ),
        }
        values, node = f"{root}/values/{service.name}.yaml.j2", f"{root}/nodes/{service.name}.py"
        files[values] = _filled(texts["values.yaml.j2"], given | own)
        files[node] = _filled(texts["example-node"], given | own)
        inputs = {service.role: f"{service.name}.{_RESULT}"}
        types_of = {service.role: next(iter(types.values()))}  # the example passes these on
    fields = {
        "name": name,
        "description": description,
        "inputs": {role: {"type": type} for role, type in types.items()},
        "services": definitions,
    }
    note = (
        "docs/appdef.md of DemandOps explains each field. To run a service once for each topic of\n"
        "an input instead of once for each application, add `each: <input>` to it."
    )
    path = f"{root}/appdef.yaml"
    files[path] = document(path, "application", "ApplicationDefinition", fields, note)
    for path, template in (
        (f"{root}/README.md", "readme"),
        (f"{chart}/Chart.yaml", "chart.yaml"),
        (f"{chart}/values.yaml", "chart-values.yaml"),
        (f"{chart}/README.md", "chart-readme"),
        (f"{chart}/templates/service.yaml", "service.yaml"),
    ):
        files[path] = _filled(texts[template], given)
    schema = charts.composed(
        f"Values of the chart {name}",
        {"node": json.loads(texts["node.schema.json"])},
        files[f"{chart}/values.yaml"],
        json.loads(shared[f"{folder}/values.schema.json"]),
        shared[f"{folder}/values.yaml"],
    )
    files[f"{chart}/values.schema.json"] = json.dumps(schema, indent=2, ensure_ascii=False) + "\n"
    registered = [
        ("charts", name, {"folder": chart, "version": _VERSION}),
        ("images", name, image.model_dump(exclude_none=True)),
    ]
    if _SYNC not in config.images:
        # every application has this image; theirs is likely to be beside that of this one
        beside = "/".join([*image.repository.split("/")[:-1], _SYNC])
        registered.append(("images", _SYNC, {"repository": beside, "tag": __version__}))
    for kind, entry, content in registered:
        path = f"registry/{kind}/{entry}.yaml"
        files[path] = document(path, kind, kind.title(), {kind: {entry: content}})
    return files


def _example_demand(
    path: str, name: str, types: Mapping[str, str], id: str, config: Config
) -> tuple[str, bool]:
    """Return the text of an example, and whether the rules of the node's domain allow it."""
    node, domain = config.nodes.get(id), config.domain_of.get(id)
    topics, rules = node.topics if node else {}, domain.rules if domain else ()
    allowing = [r for r in rules if matches(name, r.applications) and matches(id, r.nodes)]
    # The requester matches a rule that allows the application. If there is none, it matches the
    # first rule, and a person must widen the rules.
    requester = "operator"
    for rule in (allowing or rules)[:1]:
        pattern = rule.requesters[0]
        matching = next((each for each in sorted(config.nodes) if matches(each, (pattern,))), "")
        if pattern.strip("*"):
            requester = matching or pattern.replace("?", "1").replace("*", "")
    inputs = {
        role: [{"topic": topics.get(role, f"/{role.replace('-', '_')}"), "source": id}]
        for role in types
    }
    fields = {
        "demand": f"{name}-example",
        "requesters": [requester],
        "applications": [{"id": f"{id}/{name}", "type": name, "node": id, "inputs": inputs}],
    }
    note = (
        f"An example: demandops demand {path}\n"
        "`requesters` lists who demands this, by names that the rules of the access domain allow."
    )
    return document(path, "demand", "Demand", fields, note), bool(allowing or not rules)
