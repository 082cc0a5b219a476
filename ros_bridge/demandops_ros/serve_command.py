"""``demandops serve``: run the ROS 2 node until a signal stops it."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click
from demandops.base.runtime import REAL
from demandops.base.strict_yaml import read_secret
from demandops.cli.output import busy, errors
from demandops.cli.target import clusters_option, signing_option
from demandops.cluster import clusters_file, reconcile_trigger
from demandops.cluster.leadership import Leadership
from demandops.cluster.nodes import ClusterNodes
from demandops.cluster.rollouts import RolloutWatcher
from demandops.repo.reader import Reader
from demandops.serve.agenda import DEFAULT_INTERVAL, parse_interval
from demandops.serve.generator import Generator
from demandops.serve.http_server import PushWebhook
from demandops.web.follower import Follower
from demandops.web.server import WebServer
from rclpy.logging import get_logger

from demandops_ros import node_parameters, ros_process
from demandops_ros.demand_node import DemandNode

_TASK_S = 5.0


@click.command(context_settings={"ignore_unknown_options": True, "allow_extra_args": True})
@click.option(
    "--state-repo",
    envvar="DEMANDOPS_STATE_REPO",
    metavar="URL_OR_DIR",
    help="The state repo: a folder with a bare repository, or a URL that git clones; also the ROS "
    "parameter state_repo [env: DEMANDOPS_STATE_REPO].",
)
@clusters_option
@click.option(
    "--fetch-interval",
    metavar="DURATION",
    help="How often to fetch people's commits while no demand comes, such as 30s; 0 means no "
    f"fetches at an interval. Default: {DEFAULT_INTERVAL}; also the ROS parameter fetch_interval.",
)
@click.option(
    "--webhook",
    metavar="HOST:PORT",
    help="Listen at this address for push notifications (POST /push) of GitHub, GitLab, Gitea or "
    "Forgejo, and fetch when one arrives; see docs/operations.md. Off by default.",
)
@click.option(
    "--webhook-secret-file",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="The secret that signs the webhook's notifications; needed unless the webhook "
    "listens on a loopback address.",
)
@click.option(
    "--web",
    metavar="HOST:PORT",
    help="Show the state repo on a web page at this address, such as 127.0.0.1:8080; see "
    "docs/page.md. Off by default.",
)
@click.option(
    "--leader-lease",
    metavar="NAMESPACE/NAME",
    help="The Lease that makes one of several nodes the leader, which serves the actions; the "
    "others stand by. For pods; see docs/deployment.md.",
)
@signing_option
@click.pass_context
def serve(  # noqa: PLR0913, PLR0917 - one for each option
    ctx: click.Context,
    state_repo: str | None,
    access_file: Path | None,
    fetch_interval: str | None,
    webhook: str | None,
    webhook_secret_file: Path | None,
    web: str | None,
    leader_lease: str | None,
    signing_key: Path | None,
) -> None:
    """Its actions are DeploymentRequest and Demand. With --clusters, it tells clusters of a push,
    watches rollouts and takes over nodes. Everything after --ros-args goes to ROS. Parameters:
    action_name (of DeploymentRequest), demand_action_name, answer (of DeploymentRequest: pushed,
    reconciled or healthy), answer_timeout (seconds), deployment_request_ids (use, or ignore for
    clients that number their goals; docs/demand.md), state_repo, fetch_interval,
    requester_queue_limit (how many demands of one requester may be without an answer), log_level
    (debug, info, warn, error or fatal). The parameter file of the reference's node works too
    (docs/reference.md). Stop the node with Ctrl-C or SIGTERM: it publishes queued demands for some
    seconds, and the journal keeps the others for the next start.

    \b
    Examples:
      demandops serve --state-repo fleet.git
      demandops serve --state-repo https://git.example/fleet.git --clusters c.yaml
    """
    with ros_process.started(ctx.args) as ros_args, ExitStack() as parts:
        of_reference = node_parameters.read_reference_parameters(ros_args)
        settings = node_parameters.read_node_parameters(
            {
                "action_name": of_reference.get(node_parameters.ACTION_NAME),
                "state_repo": state_repo,
                "fetch_interval": fetch_interval,
            }
        )
        # set up the log first, because the generator may log demands of the journal at its start
        ros_process.log_to(get_logger("demandops"), settings["log_level"])
        secret = read_secret(webhook_secret_file) if webhook_secret_file else b""
        clusters = clusters_file.read(access_file).clusters if access_file else {}
        with busy("reading the ledger") as report:
            generator = Generator(
                settings["state_repo"],
                progress=report,
                requester_limit=settings["requester_queue_limit"],
                with_targets=bool(clusters),
                fetch_interval=parse_interval(settings["fetch_interval"]),
                signing_key=signing_key,
            )
        parts.callback(generator.close)
        signals = parts.enter_context(ros_process.StopSignals())
        REAL.when_unsound = signals.wake
        for warning in node_parameters.warnings(of_reference, generator.snapshot.state.config):
            errors.print(f"warning: {warning}")
        trigger = reconcile_trigger.ReconcileTrigger(clusters, generator.changes_since)
        parts.callback(trigger.close)
        generator.on_publish(trigger)
        trigger(generator.snapshot.state.config)  # an earlier run may have ended right after a push
        if webhook:
            push_webhook = PushWebhook(webhook, secret, generator.fetch_now)
            parts.callback(push_webhook.close)
            get_logger("demandops").info(f"listening for pushes at {push_webhook.url}")
        if web:
            # the page fetches the state repo on its own, and after each publication
            interval = parse_interval(settings["fetch_interval"])
            reader = Reader.of(settings["state_repo"])
            follower = Follower(
                reader,
                clusters,
                interval,
                push_denied=lambda: generator.remote_status.push_denied,
            )
            generator.on_publish(lambda config: follower.wake())
            page = WebServer(web, "--web", follower)
            parts.callback(page.close)
            get_logger("demandops").info(f"the page of the state repo is at {page.url}")
        status = RolloutWatcher(clusters, generator) if clusters else None
        if status is not None:
            parts.callback(status.close)
        if leader_lease:
            # lead only once the journal's demands are published, or cannot be published now
            leadership = Leadership(
                leader_lease,
                lambda: not generator.unpublished or bool(generator.remote_status.blocked),
                signals.wake,
            )
            parts.callback(leadership.close)
            signals.wait(lambda: leadership.is_leader)
        nodes = ClusterNodes(clusters, generator.nodes_changed)
        parts.callback(nodes.close)
        generator.take_over_nodes(nodes.of)  # here, because only the leader writes them
        if signals.stopping:  # a signal came before this process was the leader
            generator.close()
        else:
            _run(generator, settings, status, signals)


def _run(
    generator: Generator,
    settings: dict[str, Any],
    status: RolloutWatcher | None,
    signals: ros_process.StopSignals,
) -> None:
    node = DemandNode(
        generator,
        settings["action_name"],
        settings["demand_action_name"],
        settings["answer"],
        settings["answer_timeout"],
        status,
        ignores_ids=settings["deployment_request_ids"] == "ignore",
    )
    shown = settings | {"state_repo": generator.address}
    node_parameters.declare(node, node_parameters.PARAMETERS, shown)
    ros_process.log_to(node.get_logger(), settings["log_level"])
    # the node runs in another thread, so that the main thread notices a signal at once
    thread = ros_process.ExecutorThread(node)
    names = f"{settings['action_name']} and {settings['demand_action_name']}"
    node.get_logger().info(f"taking demands on {names} for {generator.address}")
    signals.wait()
    # the clients of open goals get their results before the node is destroyed
    node.get_logger().info(f"stopping: finishing {node.open_goals} open goals")
    published = generator.stop().result()
    if status is not None:
        status.close()  # this ends the goals that wait for a rollout
    end = REAL.monotonic() + _TASK_S
    while node.open_goals and REAL.monotonic() < end:
        REAL.sleep(0.02)
    for _ in range(2):  # tasks of the executor send the results, so wait until they have run
        done = REAL.event()
        thread.call(done.set)
        done.wait(_TASK_S)
    REAL.sleep(0.3)  # time for clients to request the results
    if not published:
        node.get_logger().warning(
            "the journal is not empty; its demands are resumed at the next start"
        )
    thread.close()
    node.close()
    node.destroy_node()
