"""``demandops demand``: send a demand over ROS 2, and hold it with ``--hold``."""

from __future__ import annotations

from typing import Any

import click
from demandops.base import strict_yaml
from demandops.base.errors import InvalidInput, fault
from demandops.base.quoting import one_line
from demandops.base.settings import DEFAULT_DEMAND_ACTION_NAME
from demandops.base.strict_yaml import read_input
from demandops.cli.json_output import output_option, show
from demandops.cli.output import done, errors, read_by
from demandops.model.config.base_model import duration_text

from demandops_ros.client import Answer, DemandClient, DemandError, HeldDemand
from demandops_ros.node_parameters import ros_name
from demandops_ros.ros_process import StopSignals


@click.command()
@click.argument("file", metavar="FILE")
@click.option("--hold", is_flag=True, help="Renew the demand until Ctrl-C, then release it.")
@click.option("--release", is_flag=True, help="Release the demand of the file.")
@click.option("--renew", is_flag=True, help="Renew the demand of the file.")
@click.option(
    "--action",
    default=DEFAULT_DEMAND_ACTION_NAME,
    show_default=True,
    metavar="NAME",
    callback=read_by(ros_name),
    help="The name of the node's action Demand.",
)
@click.option(
    "--timeout",
    type=click.FloatRange(min=0, min_open=True),
    default=60.0,
    show_default=True,
    metavar="SECONDS",
    help="How long to wait for the node and its answer together.",
)
@output_option
def demand(
    file: str, hold: bool, release: bool, renew: bool, action: str, timeout: float, output: str
) -> None:
    """Send a demand to a running node.

    FILE is a YAML document of the kind Demand (docs/demand.md), or - for standard input. If the
    demand fails, the command prints the node's reason and exits with 1.

    \b
    Examples:
      demandops demand visit.yaml
      demandops demand visit.yaml --hold
      demandops demand visit.yaml --release
    """
    if hold + release + renew > 1:
        raise click.UsageError("--hold, --release and --renew cannot be combined")
    name, text = read_input(file)
    data = strict_yaml.load(text, name)
    if not isinstance(data, dict) or data.get("kind") != "Demand":
        message = (
            "the file must be a mapping whose kind is Demand; "
            "to book a DeploymentRequest, use demandops request, which needs no node"
        )
        raise InvalidInput([fault("kind", message).within(name)])
    if release or renew:
        names = ("demand", "requesters", "request")
        data = {field: value for field, value in data.items() if field in names}
        data["operation"] = "release" if release else "renew"
    try:
        opened = DemandClient(action_name=action, timeout_s=timeout)
    except Exception as error:  # rclpy raises errors of many kinds
        raise click.ClickException(f"ROS does not start: {one_line(str(error))}") from error
    with opened as client:
        try:
            if hold:
                _hold(client, data, output)
            else:
                _print_answer(client.send(data, _print_stages(output)), output)
        except DemandError as error:
            lines = str(error).splitlines() or [error.code]
            faults = [fault("", line, code=error.code).within(file) for line in lines]
            raise InvalidInput(faults) from None
        except (ValueError, TypeError, AssertionError, AttributeError, OverflowError) as error:
            raise InvalidInput([fault("", f"is not a demand: {error}").within(file)]) from None


def _print_stages(output: str) -> Any:  # noqa: ANN401
    quiet = output == "json"
    return lambda stage, text: None if quiet else errors.print(text)


def _print_answer(answer: Answer, output: str) -> None:
    data = {
        "outcome": answer.outcome,
        "commit": answer.commit,
        "reached": answer.reached,
        "lease": answer.lease_s or None,
        "faults": [],
        "warnings": list(answer.warnings),
    }
    lease = f", for {duration_text(answer.lease_s)} unless renewed" if answer.lease_s else ""
    commit = f" in {answer.commit}" if answer.commit else ""
    done.append(f"{answer.outcome}{commit}")
    show(output, data, [f"{answer.outcome}{commit}{lease}"])
    for warning in answer.warnings if output == "text" else ():
        errors.print(f"warning: {warning}")


def _hold(client: DemandClient, data: dict[str, Any], output: str) -> None:
    client.requesters = tuple(data.get("requesters", ()))
    goal, on_stage = {**data, "operation": "put"}, _print_stages(output)
    held = HeldDemand(client, str(data.get("demand", "")), lambda: client.send(goal, on_stage))
    with StopSignals() as signals, held:
        if held.answer is not None:
            _print_answer(held.answer, output)
        if output != "json":
            errors.print("held until Ctrl-C")
        signals.wait()
    if output != "json":
        errors.print("released")
