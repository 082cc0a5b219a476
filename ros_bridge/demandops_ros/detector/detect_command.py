"""``demandops detect``: its modules for ROS are imported only if it is no replay."""

from __future__ import annotations

from pathlib import Path

import click
from demandops.base.errors import InvalidInput
from demandops.base.strict_yaml import read_input
from demandops.cli.formats import output_option
from demandops.cli.output import errors
from demandops.detect import rule_file


@click.command(context_settings={"ignore_unknown_options": True, "allow_extra_args": True})
@click.argument("rules", required=False, metavar="[RULES]")
@click.option(
    "--replay",
    "bag",
    type=click.Path(path_type=Path),
    metavar="BAG",
    help="Send nothing: try the rules on a recorded bag (a folder or an MCAP file), and print what "
    "would be demanded. Needs no ROS; needs pip install 'demandops[replay]'.",
)
@click.option(
    "--plot",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Draw the replay as an SVG file: tracks, areas, and the time of each event.",
)
@output_option
@click.pass_context
def detect(
    ctx: click.Context, rules: str | None, bag: Path | None, plot: Path | None, output: str
) -> None:
    """RULES is a file of rules (docs/detector.md); the ROS parameter "rules" can name it too. The
    detector reads the file again when the file changes. Everything after --ros-args goes to ROS.
    Stop the detector with Ctrl-C or SIGTERM. Its demands then stay booked, and the next start
    continues with them.

    \b
    Examples:
      demandops detect rules.yaml
      demandops detect rules.yaml --ros-args -p settling_time:=20.0
      demandops detect rules.yaml --replay bag --plot replay.svg
    """
    ros_args = list(ctx.args)
    if rules == "--ros-args":
        rules, ros_args = None, ["--ros-args", *ros_args]
    if bag is not None:
        if rules is None or ros_args:
            raise click.UsageError("--replay takes a file of rules, and no ROS arguments")
        _replay(rules, bag, plot, output)
        return
    for option, given in (("--plot", plot is not None), ("--output", output != "text")):
        if given:
            raise click.UsageError(f"{option} needs --replay; add --replay, or leave {option} out")
    try:
        from demandops_ros import ros_process  # noqa: PLC0415 - a replay needs no ROS
        from demandops_ros.detector.detector_node import DetectorNode  # noqa: PLC0415
    except ModuleNotFoundError as error:
        raise click.ClickException(
            f"detect needs {error.name}, which is not installed; see README.md, 'With ROS 2'"
        ) from None

    with ros_process.StopSignals() as signals, ros_process.started(ros_args):
        node = DetectorNode(rules)
        thread = ros_process.ExecutorThread(node)
        signals.wait()
        node.get_logger().info("stopping; the booked demands stay booked")
        thread.close()
        node.close()
        node.destroy_node()


def _replay(rules: str, bag: Path, plot: Path | None, output: str) -> None:
    name, text = read_input(rules)
    file = rule_file.read(text, name)
    try:
        from demandops_ros.detector import replay  # noqa: PLC0415 - needs rosbags
        from demandops_ros.detector.replay import RecordedBag  # noqa: PLC0415
    except ModuleNotFoundError as error:
        raise click.ClickException(
            f"--replay needs {error.name}, which is not installed; run pip install "
            "'demandops[replay]'"
        ) from None
    recorded = RecordedBag(bag, file)
    try:
        replayed = replay.replayed(str(bag), recorded, file)
    finally:
        recorded.close()
    for topic, type_name in recorded.unread.items():
        errors.print(f"warning: {topic} is not read, because its type is {type_name}")
    replay.show(replayed, output)
    if plot is not None:
        try:
            plot.write_text(replay.svg(replayed))
        except OSError as error:
            problem = f"cannot be written: {error.strerror or error}"
            raise InvalidInput.at("", problem, file=str(plot)) from None
