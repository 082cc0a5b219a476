"""Rollouts on a cluster that cannot be reached, or to which the generator has no access."""

from __future__ import annotations

from pathlib import Path

from demandops.cluster.clusters_file import ClusterAccess
from demandops.cluster.health import ClusterDomain, Target
from demandops.cluster.rollouts import RolloutWatcher

from tests.kit.clock import Clock
from tests.kit.cluster import Letters
from tests.kit.http import kubeconfig
from tests.kit.limits import PATIENCE_S
from tests.kit.memory import NOW

AWAY = "http://127.0.0.1:1"


def test_a_cluster_that_is_away_is_the_reason_at_the_end_of_the_time(tmp_path: Path) -> None:
    file, clock = kubeconfig(tmp_path, AWAY), Clock(NOW)
    status = RolloutWatcher({"away": ClusterAccess(kubeconfig=file)}, Letters(), runtime=clock)
    try:
        target = Target(ClusterDomain("away", "d", "ns"), "r", is_service=True)
        late = status.follow("a" * 40, [target], "healthy", timeout=60)
        soon = status.follow("a" * 40, [target], "healthy", timeout=10)
        clock.pass_(11)
        health = soon.result(PATIENCE_S)
        assert not late.done()
        clock.pass_(60)
        assert late.result(PATIENCE_S).state == "waiting"
        assert (health.state, health.object) == ("waiting", "cluster away")
        assert health.reason.startswith("cannot be read: ")
        # a demand without a target on that cluster does not wait for the cluster
        without = status.follow("a" * 40, [], "healthy", timeout=60)
        assert without.result(PATIENCE_S).state == "healthy"
    finally:
        status.close()


def test_clusters_without_a_kubeconfig_tell_nothing() -> None:
    status = RolloutWatcher({"w": ClusterAccess(receiver="https://h/hook")}, Letters())
    asked = [ClusterDomain("w", "d", "n"), ClusterDomain("x", "d", "n")]
    assert status.why_unreachable(asked) == "no access to cluster w, x"
    assert status.why_unreachable([]) == ""
    status.close()


def test_closing_answers_the_rollouts_that_are_still_followed(tmp_path: Path) -> None:
    file = kubeconfig(tmp_path, AWAY)
    status = RolloutWatcher({"away": ClusterAccess(kubeconfig=file)}, Letters())
    target = Target(ClusterDomain("away", "d", "ns"), "r", is_service=True)
    followed = status.follow("a" * 40, [target], "reconciled", timeout=600)
    status.close()
    assert followed.result(PATIENCE_S).state == "waiting"
