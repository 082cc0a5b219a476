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
from tests.kit.repo import GitRepo, Person

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


def test_no_name_is_cut_on_a_terminal_and_colors_can_be_turned_off(
    fleet: GitRepo, monkeypatch: pytest.MonkeyPatch
) -> None:
    for no_color in ("", "1"):
        monkeypatch.setenv("NO_COLOR", no_color)
        with terminal(monkeypatch, columns=80) as screen:
            assert run(["get", "services", "--state-repo", str(fleet.path)]) == 0
        assert FUSION in screen.text
        assert ("\x1b" in screen.text) is not bool(no_color)
    assert max(map(len, screen.text.splitlines())) <= 80


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


@pytest.mark.parametrize(
    ("template", "told"),
    [
        ("{.items[*].name}", "vehicle00 vehicle01"),
        ("{.items[0]['requesters'][0]} {.kind}", "vehicle00 requesters"),
        ('{range .items[*]}{.name}{"\\n"}{end}', "vehicle00\nvehicle01\n"),
        (".items[-1].name", "vehicle01"),
    ],
)
def test_a_template_picks_from_the_json(on: On, template: str, told: str) -> None:
    selected = ("get", "requesters", "-l", "requester=vehicle*")
    assert on(*selected, "-o", f"jsonpath={template}").out == f"{told}\n"


@pytest.mark.parametrize("template", ["{.items[*].nmae}", "{range .items[*]}", "{.items[}"])
def test_a_template_that_picks_nothing_is_refused(on: On, template: str) -> None:
    ran = on("get", "nodes", "-o", f"jsonpath={template}")
    assert (ran.code, ran.out) == (2, "")
    assert "--output: " in ran.err


def test_lists_are_selected_by_any_label_and_sorted_by_any_column(on: On) -> None:
    def names(*options: str) -> list[str]:
        return on("get", "nodes", "-o", "name", *options).out.split()

    assert names("-l", "type=vehicle,state=open", "--sort-by", "-name")[-1] == "vehicle00"
    assert names("-l", "requester=vehicle00", "-l", "type=edge") == ["edge"]
    assert names("--sort-by", "type")[0] == "cloud"
    ran = on("get", "nodes", "-l", "colour=red")
    assert ran.code == 2 and "nodes have no colour; they have " in ran.err
    assert on("get", "nodes", "-l", "type=vehcle").err.count("did you mean 'vehicle'") == 1
    assert on("get", "nodes", "--sort-by", "age").code == 2


def test_what_is_gone_has_its_past(on: On, fleet: GitRepo) -> None:
    assert on("decommission", "vehicle00", "--yes").code == 0
    (item,) = on.json("get", "demands", "patrol", "--gone")["items"]
    assert (item["state"], item["connections"]) == ("gone", ["patrol/link"])
    assert (item["ended"]["operation"], item["ended"]["commit"]) == ("decommission", fleet.tip)
    assert " ago by " in on("get", "demands", "patrol", "--gone").out
    assert "vehicle00" in on("get", "requesters", "--gone", "-o", "name").out.split()
    assert on("get", "demands", "--gone", "vehicle09").code == 1
    assert on("get", "nodes", "--gone").code == 2
    (release,) = on.json("get", "releases", "od-edge-vehicle00", "--gone")["items"]
    assert release["ended"]["commit"] == fleet.tip
    for output in ("text", "wide"):
        assert on("get", "releases", "--gone", "-o", output).code == 0
    # what came back is still told
    on.book(put("again", "vehicle00", applications=[], connections=[LINK]))
    (item,) = on.json("get", "requesters", "vehicle00", "--gone")["items"]
    assert (item["state"], item["ended"]["operation"]) == ("back", "decommission")
    on("release", "again", "-y")
    on.book(put("again", "vehicle00", applications=[], connections=[LINK]))
    (item,) = on.json("get", "demands", "again", "--gone")["items"]
    assert (item["state"], item["ended"]["operation"]) == ("back", "release")


@pytest.mark.usefixtures("git_environment")
def test_answered_proposals_are_gone(on: On, fleet: GitRepo, person: Person) -> None:
    person.policy(approval="required")
    for demand, answer in (("yes", "approve"), ("no", "reject")):
        goal = put(demand, "vehicle02", applications=[], connections=[LINK | {"id": demand}])
        on("demand", "-", stdin=yaml.safe_dump(goal))
        (proposal,) = on.json("get", "proposals")["items"]
        assert on(answer, proposal["name"], "-y", "--commit", proposal["commit"]).code == 0
    items = on.json("get", "proposals", "--gone")["items"]
    assert [item["ended"]["operation"] for item in items] == ["rejected", "approved"]
    assert items[0]["ended"]["by"] == "Petra Platform"
    assert on("get", "proposals", "--gone", "-o", "wide").code == 0


class TestStatus:
    @pytest.fixture
    def access(self, tmp_path: Path) -> Callable[[str], tuple[str, Path]]:
        """Return a function that gives access to a cluster at a URL: the option for it."""

        def to(url: str) -> tuple[str, Path]:
            clusters = {"c-its": {"kubeconfig": str(kubeconfig(tmp_path, url))}}
            head = {"apiVersion": "demandops/v1", "kind": "ClusterAccess"}
            (tmp_path / "clusters.yaml").write_text(json.dumps(head | {"clusters": clusters}))
            return "--clusters", tmp_path / "clusters.yaml"

        return to

    def test_status_wait_lists_unhealthy_releases_when_the_time_is_over(
        self, on: On, access: Any
    ) -> None:
        ran = on("status", "--wait", "--timeout", "1s", *access(NOBODY))
        assert ran.code == 1
        waiting, away, told = ran.err.splitlines()
        assert waiting.startswith("waiting: releases not healthy yet: ")
        assert waiting.endswith("clusters that cannot be read: c-its")
        assert away.startswith("warning: cluster 'c-its' cannot be read: Connection refused")
        assert told.replace("not well", "waiting") == waiting

    def test_status_wait_goes_on_while_the_state_repo_cannot_be_reached(
        self, on: On, access: Any, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def away(reader: Reader) -> str:
            raise RemoteAway("the remote is away")

        monkeypatch.setattr(Reader, "refresh", away)
        ran = on("status", *access(NOBODY), "--wait", "--timeout", "1s")
        assert ran.code == 1
        assert "warning: the remote is away\n" in ran.err
        assert ran.err.splitlines()[-1].startswith("not well: releases not healthy yet: ")

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
