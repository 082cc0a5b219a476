"""``demandops get`` lists what is demanded and what runs, with filters, formats and ``--watch``."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
import yaml
from demandops.base.runtime import REAL
from demandops.cli.main import run
from demandops.model.config.base_model import parse_time
from demandops.repo.git.repository import RemoteAway
from demandops.repo.reader import Reader
from demandops.views.kinds import KINDS

from tests.integration.conftest import On
from tests.kit.cli import terminal
from tests.kit.cluster import kube_api
from tests.kit.goals import EXPERIMENT, put
from tests.kit.http import kubeconfig
from tests.kit.repo import GitRepo

FUSION = "of-edge-object-detection-fusion-cf7e0180a8bb"
NOBODY = "http://127.0.0.1:9"
LINK = {"id": "patrol/link", "type": "mqtt", "source": "vehicle00", "target": "edge"}
LINK |= {"topics": [{"source": "/patrol"}]}

pytestmark = pytest.mark.usefixtures("fleet")


@pytest.fixture
def fleet(on: On, state: GitRepo) -> GitRepo:
    """A state repo with the experiment's first two demands and a demand with a lease."""
    leased = put("patrol", "vehicle00", applications=[], connections=[LINK], lease="10m")
    assert on("request", *EXPERIMENT[:2], "-", stdin=yaml.safe_dump(leased)).code == 0
    return state


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_in_every_form(on: On, fleet: GitRepo, kind: str) -> None:
    data = on.json("get", kind)
    assert (data["kind"], data["commit"]) == (kind, fleet.tip)
    assert all(item["name"] for item in data["items"])
    assert yaml.safe_load(on("get", kind[:-1], "-o", "yaml").out) == data
    for output in ("text", "wide", "name"):
        ran = on("get", kind, "-o", output)
        assert (ran.code, ran.err) == (0, "")


@pytest.mark.parametrize(
    ("later", "word", "told"),
    [
        (610, "held", "ended 10s ago, released in 20s"),
        (640, "overdue", "ended 40s ago, waits for a generator"),
    ],
)
def test_a_lease_that_is_over_and_not_booked_yet(
    on: On, monkeypatch: pytest.MonkeyPatch, later: int, word: str, told: str
) -> None:
    (item,) = on.json("get", "demands", "patrol")["items"]
    now = parse_time(item["since"]) + timedelta(seconds=later)
    monkeypatch.setattr(REAL, "now", lambda: now)
    ran = on("get", "demands", "patrol", "-o", "wide")
    assert told in ran.out
    assert word in ran.out.splitlines()[1].split()
    overdue = "a generator has yet to release the claim" in on("why", "patrol").out
    assert overdue == (word == "overdue")


def test_colors_can_be_turned_off(fleet: GitRepo, monkeypatch: pytest.MonkeyPatch) -> None:
    for no_color in ("", "1"):
        monkeypatch.setenv("NO_COLOR", no_color)
        with terminal(monkeypatch, columns=80) as screen:
            assert run(["get", "services", "--state-repo", str(fleet.path)]) == 0
        assert FUSION in screen.text
        assert ("\x1b" in screen.text) is not bool(no_color)


def test_watch_prints_the_list_again_when_it_changes(on: On, fleet: GitRepo) -> None:
    command = [sys.executable, "-m", "demandops.cli.main", "get", "leases", "--watch"]
    with subprocess.Popen(
        [*command, "-o", "json", "--state-repo", str(fleet.path)], stdout=subprocess.PIPE, text=True
    ) as watching:
        assert watching.stdout is not None
        first = json.loads(watching.stdout.readline())
        assert [item["name"] for item in first["items"]] == ["patrol"]
        on("decommission", "vehicle00", "-y")
        second = json.loads(watching.stdout.readline())
        watching.terminate()
    assert (second["items"], second["commit"]) == ([], fleet.tip)


class TestStatus:
    @pytest.fixture
    def access(self, tmp_path: Path) -> Callable[[str], tuple[str | Path, ...]]:
        """Return a function that gives access to a cluster at a URL: the options for it."""

        def to(url: str) -> tuple[str | Path, ...]:
            clusters = {"c-its": {"kubeconfig": str(kubeconfig(tmp_path, url))}}
            head = {"apiVersion": "demandops/v1", "kind": "ClusterAccess"}
            (tmp_path / "clusters.yaml").write_text(json.dumps(head | {"clusters": clusters}))
            return "--request-timeout", "1h", "--clusters", tmp_path / "clusters.yaml"

        return to

    def test_wait_lists_what_is_not_healthy_when_the_time_is_over_and_outlasts_the_remote(
        self, on: On, access: Any, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        slept = list[float]()  # no other time passes
        monkeypatch.setattr(REAL, "sleep", slept.append)
        monkeypatch.setattr(REAL, "monotonic", lambda: sum(slept))
        wait = ("status", "--wait", "--timeout", "1s", *access(NOBODY))
        ran = on(*wait)
        assert ran.code == 1
        waiting, away, told = ran.err.splitlines()
        assert waiting.startswith("waiting: releases not healthy yet: ")
        assert waiting.endswith("clusters that cannot be read: c-its")
        assert away.startswith("warning: cluster 'c-its' cannot be read: Connection refused")
        assert told.replace("not well", "waiting") == waiting

        def is_away(reader: Reader) -> str:
            raise RemoteAway("the remote is away")

        monkeypatch.setattr(Reader, "refresh", is_away)
        ran = on(*wait)
        assert (ran.code, "warning: the remote is away\n" in ran.err) == (1, True)
        assert ran.err.splitlines()[-1] == told

    def test_a_cluster_with_an_old_bootstrap_file_is_named(
        self, on: On, fleet: GitRepo, access: Any
    ) -> None:
        """A cluster's file counts as old if its Kustomization lacks the current file's digest."""
        bootstrap = yaml.safe_load_all(fleet.files()["bootstrap/c-its.yaml"])
        applied = next(one for one in bootstrap if one["kind"] == "Kustomization")
        with kube_api() as api:
            asked = ("status", *access(api.url))
            api.flux("perception", "perception", fleet.tip)
            ran = on(*asked)
            assert ran.code == 1
            assert "bootstrap/c-its.yaml (access domains: perception)" in ran.out
            assert "git show main:bootstrap/c-its.yaml | kubectl apply -f -\n" in ran.out
            assert "clusters with an old bootstrap file: 1" in ran.err
            api.put("kustomizations", "perception", "perception", {}, metadata=applied["metadata"])
            assert on(*asked, "-o", "json").json()["old_bootstraps"] == []
            policy = fleet.files()["policy/access-domains.yaml"]
            policy = policy.replace("podSecurity: host-network", "podSecurity: privileged")
            fleet.commit({"policy/access-domains.yaml": policy})
            assert on("request", EXPERIMENT[2]).code == 0
            (old,) = on(*asked, "-o", "json").json()["old_bootstraps"]
            assert (old["cluster"], old["domains"]) == ("c-its", ["perception"])

    def test_an_object_that_belongs_to_no_release_is_named(
        self, on: On, fleet: GitRepo, access: Any
    ) -> None:
        flux = {f"kustomize.toolkit.fluxcd.io/{key}": "perception" for key in ("name", "namespace")}
        with kube_api() as api:
            asked = ("status", *access(api.url))
            api.put("deployments", "perception", "mqtt-gone", {}, metadata={"labels": flux})
            api.put("deployments", "perception", "of-a-person", {})
            api.put("helmreleases", "perception", FUSION, {}, metadata={"labels": flux})
            assert on(*asked, "-o", "json").json()["orphans"] == []  # not applied yet
            api.flux("perception", "perception", fleet.tip)
            (orphan,) = on(*asked, "-o", "json").json()["orphans"]
            ran = on(*asked)
        command = "kubectl -n perception delete --ignore-not-found "
        command += "deployment/mqtt-gone configmap/mqtt-gone"
        place = {"cluster": "c-its", "namespace": "perception", "name": "mqtt-gone"}
        assert orphan == place | {"kind": "Deployment", "command": command}
        assert command in ran.out
        assert "objects that belong to no release: 1" in ran.err and ran.code == 1
