"""``demandops new``: files of a state repo for people to edit, valid from the start."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import click

from demandops.base import addresses
from demandops.base.errors import InvalidInput, StateRepoError
from demandops.base.settings import data_folder
from demandops.cli.authoring import scaffold
from demandops.cli.authoring.scaffold import LIBRARY_FOLDER, ApplicationPlan, ServicePlan
from demandops.cli.changes.override import effect_options, override_text
from demandops.cli.json_output import Command, output_option, show
from demandops.cli.output import busy
from demandops.decide.state import State, try_configuration
from demandops.model.config.config import CONFIG_ROOTS, DOMAINS_FILE, Config
from demandops.model.config.load import load
from demandops.model.config.registry import Image
from demandops.model.ledger.ledger import Ledger
from demandops.repo import new_repo
from demandops.repo.git import tree as trees
from demandops.repo.merge_check import edited_checkout
from demandops.templating.evaluator import EVALUATE

_INPUT = re.compile(r"(?P<role>[^=]+)=(?P<type>.+)")
_SHORT_TYPE = re.compile(r"(?P<package>\w+)/(?P<name>\w+)")
_SERVICE = re.compile(r"(?P<name>[^=]+)=(?P<package>[^/]+)/(?P<file>[^/]+)")
Files = Mapping[str, str]


def _directory(what: str) -> Callable[[Command], Command]:
    return click.option(
        "--directory",
        "-C",
        type=click.Path(path_type=Path, exists=True, file_okay=False),
        default=Path(),
        metavar="DIR",
        help=f"{what} Default: this folder.",
    )


@click.group()
def new() -> None:
    """Write a new application, override or image.

    The files in the state repo are valid as they are: `demandops check` passes. `new image` writes
    to the repository of a ROS package instead. The command changes no existing file and commits
    nothing.

    \b
    Examples:
      demandops new application tracking
    """


@new.command()
@click.argument("name")
@click.option(
    "--description", default="", metavar="TEXT", help="What the application does, in a sentence."
)
@click.option(
    "--input",
    "inputs",
    multiple=True,
    metavar="ROLE=TYPE",
    help="An input and its message type: camera=sensor_msgs/msg/Image. May be repeated.",
)
@click.option(
    "--service",
    "services",
    multiple=True,
    metavar="NAME=PACKAGE/FILE",
    help="A service and the launch file that it runs: detector=my_package/detector.launch.py. May "
    "be repeated. Each further service reads the outputs of the service before it.",
)
@click.option("--image", default="", metavar="IMAGE", help="The image, with a tag or digest.")
@click.option(
    "--node",
    default="",
    metavar="ID",
    help="The node of the example demand. Default: an edge server if there is one.",
)
@_directory("The checked-out state repo.")
@output_option
def application(  # noqa: PLR0913 - as many as options
    name: str,
    *,
    description: str,
    inputs: tuple[str, ...],
    services: tuple[str, ...],
    image: str,
    node: str,
    directory: Path,
    output: str,
) -> None:
    """Write a new application: definition, values, chart, registry, README and a demand.

    On a terminal, the command asks for --input, --service and --image if they are missing.

    \b
    Examples:
      demandops new application tracking
      demandops new application tracking --input camera=sensor_msgs/msg/Image
    """
    given = {"--input": inputs, "--service": services, "--image": (image,) if image else ()}
    existing, config = _read_configuration(directory)
    # before the questions, so that nobody answers them in vain
    scaffold.refuse_name(name, config)
    missing = [option for option, values in given.items() if not values]
    if missing and not sys.stdin.isatty():
        options = ", ".join(f"'{option}'" for option in missing)
        raise click.UsageError(f"Missing option{'s' * (len(missing) > 1)} {options}.")
    values = {option: given[option] or _asked(*_QUESTIONS[option]) for option in given}
    planned_services = tuple(map(_service, values["--service"]))
    planned_inputs = dict(map(_input, values["--input"]))
    planned_image = _image(values["--image"][0])
    # a demand can name only nodes in an access domain
    nodes = sorted(config.domain_of, key=lambda id: (config.nodes[id].type != "edge", id))
    if not (node or nodes):
        raise StateRepoError(
            "the inventory has no node in an access domain, so no demand can be made; add one "
            "first, in inventory/nodes.yaml"
        )
    plan = ApplicationPlan(
        name,
        description or f"Runs {', '.join(service.name for service in planned_services)}",
        planned_inputs,
        planned_services,
        planned_image,
        node or nodes[0],
    )
    then = [
        "when the files are on main, try the application: demandops request --dry-run "
        f"{directory / 'appdefs' / name / 'demand.yaml'}"
    ]
    if domain := scaffold.closed_domain(plan, config):
        then.insert(
            0,
            f"no rule of access domain '{domain.name}' allows demands for this application on "
            f"{plan.node}; to allow them, widen a rule, such as '{domain.rules[0].name}', in "
            f"{config.file_of(DOMAINS_FILE, domain.name)}",
        )
    library, texts = new_repo.files_of_library(LIBRARY_FOLDER), _texts("application")
    files = scaffold.application_files(plan, config, library, texts)
    _lay_down(directory, existing, files, output, then)


@new.command()
@click.argument("name")
@click.option("-m", "--reason", required=True, metavar="TEXT", help="Why the override is needed.")
@click.option("--owner", required=True, metavar="NAME", help="Who is responsible.")
@click.option(
    "--service", "services", multiple=True, metavar="PATTERN", help="Select services by name."
)
@click.option(
    "--application", "apps", multiple=True, metavar="PATTERN", help="Select applications by id."
)
@click.option("--node", "nodes", multiple=True, metavar="PATTERN", help="Select nodes by id.")
@effect_options
@_directory("The checked-out state repo.")
@output_option
def override(  # noqa: PLR0913 - as many as options
    name: str,
    *,
    reason: str,
    owner: str,
    services: tuple[str, ...],
    apps: tuple[str, ...],
    nodes: tuple[str, ...],
    hold: bool,
    deny: bool,
    keep: bool,
    replicas: int | None,
    directory: Path,
    output: str,
) -> None:
    """Write a new override with one effect.

    \b
    Examples:
      demandops new override calm --node edge --deny -m Works --owner petra
    """
    given = {"services": services, "applications": apps, "nodes": nodes}
    select = {field: [*values] for field, values in given.items() if values}
    if not select:
        raise click.UsageError("say what the override selects: --service, --application or --node")
    flags = {"hold": hold or None, "deny": deny or None, "keep": keep or None}
    effects = {**flags, "replicas": replicas}
    if sum(value is not None for value in effects.values()) != 1:
        raise click.UsageError("give exactly one effect: --hold, --deny, --keep or --replicas")
    existing, config = _read_configuration(directory)
    if name in config.overrides:
        raise InvalidInput.at("NAME", f"'{name}' is an override already; choose another name")
    fields = {"reason": reason, "owner": owner, "select": [select], **effects}
    note = "overrides/README.md lists all effects and selectors of overrides, and when they end."
    files = {f"overrides/{name}.yaml": override_text(name, fields, note)}
    _lay_down(directory, existing, files, output, [])


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
    "url",
    required=True,
    metavar="URL",
    help="The state repo to which the image is proposed.",
)
@_directory("The repository of the ROS package.")
@output_option
def image(name: str, repository: str, url: str, directory: Path, output: str) -> None:
    """Write a container file and pipelines for a ROS package of your own.

    NAME is the image's name in registry/images/. The pipelines, for GitHub and GitLab, test the
    package. When you push a tag, they also build the image and propose it, with its digest, to the
    state repo.

    \b
    Examples:
      demandops new image cam --repository ghcr.io/me/cam --state-repo git@host:f
    """
    then = ["keep .github/workflows/image.yml or .gitlab-ci.yml, whichever you need"]
    files = scaffold.image_files(name, repository, url, _texts("image"))
    _write_files(directory, files, output, then)


def _texts(what: str) -> Files:
    folder = data_folder("templates") / "scaffold" / what
    return {path.name: path.read_text(encoding="utf-8") for path in sorted(folder.iterdir())}


def _asked(question: str, check: Callable[[str], object], most: int | None) -> tuple[str, ...]:
    """Ask until the answer is at most ``most`` valid words; ``check`` raises for another word."""

    def valid(answer: str) -> tuple[str, ...]:
        if not (words := tuple(answer.split())):
            raise click.UsageError(
                "an answer is needed; Ctrl-C ends the command, and nothing is written"
            )
        if most is not None and len(words) > most:
            raise click.UsageError(f"'{answer}' has {len(words)} words; give {most}")
        for word in words:
            check(word)
        return words

    words: tuple[str, ...]
    words = click.prompt(question, default="", show_default=False, value_proc=valid)
    return words


def _input(text: str) -> tuple[str, str]:
    if not (match := _INPUT.fullmatch(text)):
        raise click.BadParameter(
            f"'{text}' is not ROLE=TYPE; write it like camera=sensor_msgs/msg/Image",
            param_hint="--input",
        )
    if short := _SHORT_TYPE.fullmatch(match["type"]):
        raise click.BadParameter(
            f"'{text}' has no message type of ROS 2; write "
            f"{match['role']}={short['package']}/msg/{short['name']}",
            param_hint="--input",
        )
    return match["role"], match["type"]


def _service(text: str) -> ServicePlan:
    if not (match := _SERVICE.fullmatch(text)):
        raise click.BadParameter(
            f"'{text}' is not NAME=PACKAGE/FILE; write it like "
            "detector=my_package/detector.launch.py",
            param_hint="--service",
        )
    return ServicePlan(match["name"], match["package"], match["file"])


def _image(text: str) -> Image:
    try:
        image = addresses.image(text)
    except ValueError as error:
        raise click.BadParameter(str(error), param_hint="--image") from None
    if not (image.tag or image.digest):
        raise click.BadParameter(
            f"'{text}' has no tag or digest; write {text}:TAG", param_hint="--image"
        )
    return Image(repository=image.name, tag=image.tag or None, digest=image.digest or None)


# Maps an option to the arguments of `_asked` that ask for the option's values.
_QUESTIONS: Mapping[str, tuple[str, Callable[[str], object], int | None]] = {
    "--input": (
        "Inputs, as role=type, such as camera=sensor_msgs/msg/Image; separate several by spaces",
        _input,
        None,
    ),
    "--service": (
        "Services, as name=package/file, such as detector=my_package/detector.launch.py; separate "
        "several by spaces",
        _service,
        None,
    ),
    "--image": ("Image, with a tag or digest, such as ghcr.io/me/tracking:1.0", _image, 1),
}


def _read_configuration(directory: Path) -> tuple[Files, Config]:
    with busy("reading the state repo"):
        with edited_checkout.opened(directory) as (_, tree):
            people = trees.texts(tree, CONFIG_ROOTS)
        return people, load(people)


def _lay_down(
    directory: Path, existing: Files, new_files: Files, output: str, then: list[str]
) -> None:
    if strange := [path for path in new_files if ".." in path.split("/") or "//" in path]:
        raise StateRepoError(f"{strange[0]} is not a valid file name; choose another name")
    # nothing is written unless the whole configuration is valid with it
    with busy("rendering an example of each application"):
        try_configuration(State(load({**existing, **new_files}), Ledger(), EVALUATE))
    hints = [f"to check the files: demandops check {directory}", *then]
    _write_files(directory, new_files, output, hints)


def _write_files(directory: Path, files: Files, output: str, then: list[str]) -> None:
    if there := [path for path in files if (directory / path).exists()]:
        raise StateRepoError(f"{directory / there[0]} exists; move it away (nothing was changed)")
    for path, text in files.items():
        (directory / path).parent.mkdir(parents=True, exist_ok=True)
        (directory / path).write_text(text, encoding="utf-8")
    lines = [f"new: {directory / path}" for path in sorted(files)]
    show(output, {"files": sorted(files)}, [*lines, *then])
