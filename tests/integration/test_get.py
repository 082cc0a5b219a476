"""``demandops get`` lists what is demanded and what runs, with filters, formats and ``--watch``."""

from __future__ import annotations

import json
import subprocess
import sys
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
import yaml
from demandops.base.runtime import REAL
from demandops.cli.views.get import KINDS
from demandops.model.config.override import parse_time
from demandops.repo.git.repository import RemoteAway
from demandops.repo.reader import Reader

from tests.kit.cli import Run
from tests.kit.goals import APP, EXPERIMENT, perception, put
from tests.kit.http import kubeconfig
from tests.kit.kube_api import kube_api
from tests.kit.repo import GitRepo, git
from tests.kit.terminal import terminal

FUSION = "of-edge-object-detection-fusion-cf7e0180a8bb"


@pytest.fixture
def fleet(demandops: Run, state: GitRepo) -> GitRepo:
    """A state repo with the experiment's first two demands and a demand with a lease."""
    link = {"id": "patrol/link", "type": "mqtt", "source": "vehicle00", "target": "edge"}
    link |= {"topics": [{"source": "/patrol"}]}
    leased = put("patrol", "vehicle00", applications=[], connections=[link], lease="10m")
    given = yaml.safe_dump(leased)
    ran = demandops("request", *EXPERIMENT[:2], "-", "--state-repo", state.path, stdin=given)
    assert ran.code == 0, ran.err
    return state


@pytest.fixture
def names(demandops: Run, fleet: GitRepo) -> Any:
    """Return a function that lists the names of all items of a kind."""

    def call(*args: str) -> list[str]:
        ran = demandops("get", *args, "--state-repo", fleet.path, "-o", "name")
        assert (ran.code, ran.err) == (0, "")
        return [line for line in ran.out.splitlines() if line]

    return call


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("output", ["text", "wide", "name", "json", "yaml"])
def test_every_kind_in_every_form(demandops: Run, fleet: GitRepo, kind: str, output: str) -> None:
    ran = demandops("get", kind, "--state-repo", fleet.path, "-o", output)
    assert (ran.code, ran.err) == (0, "")
    if output in ("json", "yaml"):
        data = yaml.safe_load(ran.out)
        assert (data["kind"], data["commit"]) == (kind, fleet.tip)
        assert all(item["name"] for item in data["items"])
        singular = demandops("get", kind[:-1], "--state-repo", fleet.path, "-o", output)
        assert singular.out == ran.out


def test_what_is_listed(names: Any) -> None:
    assert names("nodes", "--application", APP) == ["edge", "station00", "vehicle00", "vehicle01"]
    assert names("services", "--node", "edge", "--requester", "vehicle01") == [
        "od-edge-station00",
        FUSION,
    ]
    assert names("connections", "--node", "vehicle0*", "--domain", "perception") == [
        "patrol/link",
        "vehicle00/edge",
        "vehicle01/edge",
    ]
    assert names("leases") == names("demands", "patrol") == ["patrol"]
    assert len(names("demands")) == 3
    assert len(names("claims", "--requester", "vehicle01")) == 3


def test_a_demand_tells_what_it_holds(demandops: Run, fleet: GitRepo) -> None:
    ran = demandops("get", "demands", "patrol", "--state-repo", fleet.path, "-o", "json")
    (item,) = ran.json()["items"]
    assert item["lease"]["seconds"] == 600
    assert (item["state"], item["connections"], item["applications"]) == (
        "held",
        ["patrol/link"],
        [],
    )
    told = demandops("get", "leases", "--state-repo", fleet.path).out
    assert "10m   in 9m" in told


@pytest.mark.parametrize(
    ("later", "word", "told"),
    [
        (610, "held", "ended 10s ago, released in 20s"),
        (640, "overdue", "ended 40s ago, waits for a generator"),
    ],
)
def test_a_lease_that_is_over_and_not_booked_yet(
    demandops: Run,
    fleet: GitRepo,
    monkeypatch: pytest.MonkeyPatch,
    later: int,
    word: str,
    told: str,
) -> None:
    where = ("patrol", "--state-repo", fleet.path)
    (item,) = demandops("get", "demands", *where, "-o", "json").json()["items"]
    now = parse_time(item["since"]) + timedelta(seconds=later)
    monkeypatch.setattr(REAL, "now", lambda: now)
    ran = demandops("get", "demands", *where)
    assert told in ran.out
    assert word in ran.out.splitlines()[1].split()
    overdue = (
        "which has passed; a generator has yet to release the claim" in demandops("why", *where).out
    )
    assert overdue == (word == "overdue")


def test_a_node_that_claims_use_and_a_drained_one(demandops: Run, fleet: GitRepo) -> None:
    nodes = fleet.files()["inventory/nodes.yaml"]
    more = "id: cloud\n    drained: true\n    properties: {gpu: true}"
    fleet.commit({"inventory/nodes.yaml": nodes.replace("id: cloud", more)})
    wide = demandops("get", "nodes", "-o", "wide", "--state-repo", fleet.path)
    assert "gpu: true" in wide.out
    ran = demandops("get", "nodes", "--state-repo", fleet.path)
    rows = {line.split()[0]: line.split() for line in ran.out.splitlines()}
    assert rows["cloud"][4] == "drained"
    assert rows["edge"][4:6] == ["open", "7"]


def test_names_and_filters_that_fit_nothing_known_are_refused(
    demandops: Run, fleet: GitRepo
) -> None:
    where = ("--state-repo", fleet.path)
    ran = demandops("get", "services", "--node", "egde", "--requester", "vehicle1", *where)
    assert (ran.code, ran.out) == (1, "")
    assert ran.err == (
        "error: --node: nothing is called 'egde'; did you mean 'edge'?\n"
        "error: --requester: nothing is called 'vehicle1'; did you mean 'vehicle01'?\n"
    )
    ran = demandops("get", "demands", "patrl", *where)
    assert ran.err == "error: nothing is called 'patrl'; did you mean 'patrol'?\n"
    ran = demandops("get", "proposals", "--node", "edge", *where)
    assert ran.code == 2
    assert "proposals have no --node; they can be filtered by --requester" in ran.err
    ran = demandops("get", "vehicles", *where)
    assert ran.code == 2
    assert "there is no kind 'vehicles'; did you mean 'services'?" in ran.err
    ran = demandops("get", "--state-repo", fleet.path)
    assert ran.code == 2
    assert "Missing argument 'KIND': one of claims, connections, demands, " in ran.err
    assert demandops("get", "leases", "--node", "cloud", *where).out == "no leases\n"


def test_an_override_that_a_hold_keeps_back_is_not_said_to_be_in_force(
    demandops: Run, fleet: GitRepo
) -> None:
    head = "apiVersion: demandops/v1\nkind: Override\nreason: why\nowner: petra\n"
    select = "select: [{services: [object-fusion]}]\n"
    fleet.commit(
        {
            "overrides/calm.yaml": f"{head}{select}priority: 5\nhold: true\n",
            "overrides/more.yaml": f"{head}{select}replicas: 2\n",
        }
    )
    ran = demandops("get", "overrides", "--state-repo", fleet.path, "-o", "json")
    assert {one["name"]: one["state"] for one in ran.json()["items"]} == {
        "calm": "not rendered yet",
        "more": "held back",
    }
    waits = "warning: a generator has yet to write or remove 1 generated file: clusters/"
    assert ran.err.startswith(waits)
    ran = demandops("why", FUSION, "--state-repo", fleet.path, "-o", "json")
    assert [Path(path).stem for path in ran.json()["not_rendered"]] == [FUSION]
    status = demandops("status", "--state-repo", fleet.path)
    assert status.code == 1
    assert "not well: files that a generator has yet to write or remove: 1\n" in status.err
    assert demandops("request", EXPERIMENT[2], "--state-repo", fleet.path).code == 0
    ran = demandops("get", "overrides", "calm", "--state-repo", fleet.path, "-o", "json")
    assert (ran.json()["items"][0]["state"], ran.err) == ("in force", "")


def test_no_name_is_cut_on_a_terminal_and_colors_can_be_turned_off(
    demandops: Run, fleet: GitRepo, monkeypatch: pytest.MonkeyPatch
) -> None:
    from demandops.cli.main import run

    for no_color in ("", "1"):
        monkeypatch.setenv("NO_COLOR", no_color)
        with terminal(monkeypatch, columns=80) as screen:
            assert run(["get", "services", "--state-repo", str(fleet.path)]) == 0
        assert FUSION in screen.text
        assert ("\x1b" in screen.text) is not bool(no_color)
    assert max(map(len, screen.text.splitlines())) <= 80


def test_watch_prints_the_list_again_when_it_changes(demandops: Run, fleet: GitRepo) -> None:
    command = [sys.executable, "-m", "demandops.cli.main", "get", "leases", "--watch"]
    with subprocess.Popen(
        [*command, "-o", "json", "--state-repo", str(fleet.path)], stdout=subprocess.PIPE, text=True
    ) as watching:
        assert watching.stdout is not None
        first = json.loads(watching.stdout.readline())
        assert [item["name"] for item in first["items"]] == ["patrol"]
        demandops("decommission", "vehicle00", "--state-repo", fleet.path)
        second = json.loads(watching.stdout.readline())
        watching.terminate()
    assert (second["items"], second["commit"]) == ([], fleet.tip)


class TestWhichStateRepo:
    def test_in_a_checkout_no_option_is_needed(
        self, demandops: Run, fleet: GitRepo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        clone = tmp_path / "clone"
        git(tmp_path, "clone", "--quiet", str(fleet.path), str(clone))
        monkeypatch.chdir(clone / "inventory")
        for command in ("get demands", "bookkeeping", f"why {FUSION}", "log", "status", "verify"):
            ran = demandops(*command.split())
            assert ran.code == 0, ran.err
        git(clone, "checkout", "--quiet", "HEAD~1")
        assert demandops("get", "leases").out == "no leases\n"
        assert demandops("get", "proposals").out == "no proposals\n"

    def test_what_writes_there_writes_to_its_remote(
        self, demandops: Run, fleet: GitRepo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        clone = tmp_path / "clone"
        git(tmp_path, "clone", "--quiet", fleet.path.as_uri(), str(clone))
        monkeypatch.chdir(clone)
        before = fleet.tip
        ran = demandops("request", "-", stdin=yaml.safe_dump(perception(id="more")))
        assert (ran.code, ran.err) == (0, "to see the new commit in this checkout: git pull\n")
        assert git(fleet, "rev-parse", "main~1") == before
        more = yaml.safe_dump(perception(id="again"))
        told = demandops("request", "-", "--state-repo", fleet.path, stdin=more)
        assert (told.code, told.err) == (0, "")
        git(clone, "remote", "remove", "origin")
        for command in (
            "request -",
            "decommission vehicle00",
            "rollback HEAD",
            "upgrade",
            "override create calm --node edge --hold -m Tests",
            "suspend --requester vehicle00 -m Tests",
        ):
            ran = demandops(*command.split(), "--dry-run", stdin=more)
            assert ran.code == 0, f"{command}: {ran.err}"
        ran = demandops("request", "-", stdin=more)
        assert ran.code == 2
        assert "has no remote 'origin' to write to; give --state-repo" in ran.err

    def test_a_context_is_named_once(
        self, demandops: Run, fleet: GitRepo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
        assert demandops("config", "list").out == "no contexts; see demandops config set\n"
        ran = demandops("get", "leases")
        assert ran.code == 2
        assert "Which state repo? Give --state-repo, run the command in a checkout" in ran.err
        assert demandops("config", "set", "fleet", "--state-repo", fleet.path).code == 0
        assert demandops("config", "set", "gone", "--state-repo", tmp_path / "gone").code == 0
        assert demandops("get", "leases", "-o", "name").out == "patrol\n"
        assert demandops("get", "leases", "--context", "gone").code == 1
        with monkeypatch.context() as environment:
            environment.setenv("DEMANDOPS_STATE_REPO", str(tmp_path / "gone"))
            assert demandops("get", "leases").code == 1
            assert demandops("get", "leases", "--context", "fleet", "-o", "name").code == 0
        assert demandops("config", "use", "gone").code == 0
        assert demandops("get", "leases").code == 1
        assert demandops("get", "leases", "--context", "fleet", "-o", "name").out == "patrol\n"
        ran = demandops("get", "leases", "--context", "flet")
        assert ran.err == (
            f"error: {tmp_path}/config/demandops/contexts.yaml: --context: there is no context "
            "'flet'; did you mean 'fleet'?\n"
        )
        assert demandops("config", "delete", "gone").code == 0
        listed = demandops("config", "list", "-o", "json").json()
        assert (listed["current"], [*listed["contexts"]]) == (None, ["fleet"])

    def test_a_relative_folder_of_the_environment_counts_only_where_it_exists(
        self, demandops: Run, fleet: GitRepo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("DEMANDOPS_STATE_REPO", fleet.path.name)
        monkeypatch.chdir(fleet.path.parent)
        assert demandops("get", "leases", "-o", "name").out == "patrol\n"
        git(tmp_path, "clone", "--quiet", str(fleet.path), str(tmp_path / "checkout"))
        monkeypatch.chdir(tmp_path / "checkout" / "inventory")
        assert demandops("get", "leases", "-o", "name").out == "patrol\n"
        assert demandops("decommission", "vehicle00", "--dry-run").code == 0
        (tmp_path / "other").mkdir()
        monkeypatch.chdir(tmp_path / "other")
        ran = demandops("get", "leases")
        assert ran.code == 2
        assert ran.err.endswith(
            f"Error: DEMANDOPS_STATE_REPO is '{fleet.path.name}', a relative folder that does not "
            f"exist in {tmp_path}/other; set it to an absolute path, or give --state-repo\n"
        )

    def test_a_context_lends_its_clusters_to_its_own_state_repo_alone(
        self, demandops: Run, fleet: GitRepo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
        missing = tmp_path / "clusters.yaml"
        options = ("--state-repo", fleet.path.as_uri(), "--clusters", missing)
        assert demandops("config", "set", "fleet", *options).code == 0
        assert str(missing) in demandops("status").err
        assert demandops("status", "--state-repo", fleet.path).code == 0
        clone = tmp_path / "clone"
        git(tmp_path, "clone", "--quiet", fleet.path.as_uri(), str(clone))
        monkeypatch.chdir(clone)
        assert str(missing) in demandops("status").err

    def test_a_file_that_is_not_valid_is_told_with_its_place(
        self, demandops: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
        file = tmp_path / "demandops" / "contexts.yaml"
        file.parent.mkdir()
        file.write_text("apiVersion: demandops/v1\nkind: Contexts\ncurrent: a\ncontexts: {b: {}}\n")
        ran = demandops("get", "demands")
        assert ran.code == 1
        assert f"{file}:4: contexts.b.stateRepo: " in ran.err


class TestStatus:
    def test_a_cluster_that_is_misspelled_is_told(
        self, demandops: Run, fleet: GitRepo, tmp_path: Path
    ) -> None:
        file = tmp_path / "clusters.yaml"
        file.write_text(
            "apiVersion: demandops/v1\nkind: ClusterAccess\n"
            "clusters: {c-itz: {receiver: 'http://127.0.0.1:9/hook'}}\n"
        )
        ran = demandops("status", "--state-repo", fleet.path, "--clusters", file)
        assert ran.err == (
            "warning: --clusters: the inventory has no cluster 'c-itz'; did you mean 'c-its'?\n"
        )
        assert ran.code == 0

    def test_status_wait_lists_unhealthy_releases_when_the_time_is_over(
        self, demandops: Run, fleet: GitRepo, tmp_path: Path
    ) -> None:
        where = ("--state-repo", fleet.path)
        ran = demandops("status", "--wait", *where)
        assert ran.code == 2
        assert "--wait needs --clusters FILE" in ran.err
        cluster = {"name": "c", "cluster": {"server": "http://127.0.0.1:9"}}
        context = {"name": "c", "context": {"cluster": "c", "user": "u"}}
        users = [{"name": "u", "user": {}}]
        config = {"clusters": [cluster], "contexts": [context], "users": users}
        (tmp_path / "config").write_text(yaml.safe_dump({**config, "current-context": "c"}))
        file = tmp_path / "clusters.yaml"
        file.write_text(
            "apiVersion: demandops/v1\nkind: ClusterAccess\n"
            f"clusters: {{c-its: {{kubeconfig: {tmp_path}/config}}}}\n"
        )
        ran = demandops("status", "--wait", "--timeout", "1s", *where, "--clusters", file)
        assert ran.code == 1
        waiting, away, told = ran.err.splitlines()
        assert waiting.startswith("waiting: releases not healthy yet: ")
        assert waiting.endswith("clusters that cannot be read: c-its")
        assert away.startswith("warning: cluster 'c-its' cannot be read: MaxRetryError: ")
        assert told.replace("not well", "waiting") == waiting

    def test_status_wait_goes_on_while_the_state_repo_cannot_be_reached(
        self, demandops: Run, fleet: GitRepo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def away(reader: Reader) -> str:
            raise RemoteAway("the remote is away")

        monkeypatch.setattr(Reader, "refresh", away)
        file = tmp_path / "clusters.yaml"
        file.write_text(
            "apiVersion: demandops/v1\nkind: ClusterAccess\n"
            f"clusters: {{c-its: {{kubeconfig: {kubeconfig(tmp_path, 'http://127.0.0.1:9')}}}}}\n"
        )
        asked = ("status", "--state-repo", fleet.path, "--clusters", file)
        ran = demandops(*asked, "--wait", "--timeout", "1s")
        assert ran.code == 1
        assert "warning: the remote is away\n" in ran.err
        assert ran.err.splitlines()[-1].startswith("not well: releases not healthy yet: ")

    def test_an_input_that_no_longer_arrives(self, demandops: Run, fleet: GitRepo) -> None:
        where = ("--state-repo", fleet.path)
        assert demandops("status", *where, "-o", "json").json()["missing_inputs"] == []
        suspended = ("--connection", "vehicle00/edge", "-m", "in the workshop")
        assert demandops("suspend", *suspended, *where).code == 0
        (item,) = demandops("get", "overrides", *where, "-o", "json").json()["items"]
        assert item["state"] == "not rendered yet", "the files must be those of stopped clients"
        assert demandops("request", EXPERIMENT[2], *where).code == 0
        (item,) = demandops("get", "overrides", *where, "-o", "json").json()["items"]
        assert item["state"] == "in force"
        ran = demandops("status", *where)
        told = [
            f"application '{APP}': {role} /vehicles/vehicle00/{topic} does not arrive: no "
            "connection carries it from 'vehicle00' to 'edge'"
            for role, topic in (
                ("ego_data", "ego_data"),
                ("point_cloud", "drivers/lidar/pointcloud"),
            )
        ]
        assert ran.err.splitlines()[:2] == [f"warning: {each}" for each in told]
        assert ran.code == 0
        assert demandops("why", FUSION, *where, "-o", "json").json()["missing_inputs"] == told

    def test_a_cluster_with_an_old_bootstrap_file_is_named(
        self, demandops: Run, fleet: GitRepo, tmp_path: Path
    ) -> None:
        """A cluster's file counts as old if its Kustomization lacks the current file's digest."""
        bootstrap = fleet.files()["bootstrap/c-its.yaml"]
        applied = next(
            one for one in yaml.safe_load_all(bootstrap) if one["kind"] == "Kustomization"
        )
        file = tmp_path / "clusters.yaml"
        with kube_api() as api:
            file.write_text(
                "apiVersion: demandops/v1\nkind: ClusterAccess\n"
                f"clusters: {{c-its: {{kubeconfig: {kubeconfig(tmp_path, api.url)}}}}}\n"
            )
            asked = ("status", "--state-repo", fleet.path, "--clusters", file)
            api.flux("perception", "perception", fleet.tip)
            ran = demandops(*asked)
            assert ran.code == 1
            assert (
                "cluster 'c-its' does not have the current bootstrap/c-its.yaml (access domains: "
                "perception); an administrator of the cluster must apply it: git show "
                "main:bootstrap/c-its.yaml | kubectl apply -f -\n"
            ) in ran.out
            assert "clusters with an old bootstrap file: 1" in ran.err
            api.put("kustomizations", "perception", "perception", {}, metadata=applied["metadata"])
            assert demandops(*asked, "-o", "json").json()["old_bootstraps"] == []
            policy = fleet.files()["policy/access-domains.yaml"]
            policy = policy.replace("podSecurity: host-network", "podSecurity: privileged")
            fleet.commit({"policy/access-domains.yaml": policy})
            assert demandops("request", EXPERIMENT[2], "--state-repo", fleet.path).code == 0
            (old,) = demandops(*asked, "-o", "json").json()["old_bootstraps"]
            assert (old["cluster"], old["domains"]) == ("c-its", ["perception"])

    def test_an_object_that_belongs_to_no_release_is_named(
        self, demandops: Run, fleet: GitRepo, tmp_path: Path
    ) -> None:
        flux = {f"kustomize.toolkit.fluxcd.io/{key}": "perception" for key in ("name", "namespace")}
        file = tmp_path / "clusters.yaml"
        asked = ("status", "--state-repo", fleet.path, "--clusters", file)
        with kube_api() as api:
            file.write_text(
                "apiVersion: demandops/v1\nkind: ClusterAccess\n"
                f"clusters: {{c-its: {{kubeconfig: {kubeconfig(tmp_path, api.url)}}}}}\n"
            )
            api.put("deployments", "perception", "mqtt-gone", {}, metadata={"labels": flux})
            api.put("deployments", "perception", "of-a-person", {})
            api.put("helmreleases", "perception", FUSION, {}, metadata={"labels": flux})
            assert demandops(*asked, "-o", "json").json()["orphans"] == []  # not applied yet
            api.flux("perception", "perception", fleet.tip)
            (orphan,) = demandops(*asked, "-o", "json").json()["orphans"]
            ran = demandops(*asked)
        command = "kubectl -n perception delete --ignore-not-found "
        command += "deployment/mqtt-gone configmap/mqtt-gone"
        assert orphan == {
            "cluster": "c-its",
            "kind": "Deployment",
            "namespace": "perception",
            "name": "mqtt-gone",
            "command": command,
        }
        assert (
            "Deployment perception/mqtt-gone on cluster 'c-its' belongs to no release any more; an "
            f"administrator of the cluster must delete it: {command}\n"
        ) in ran.out
        assert "objects that belong to no release: 1" in ran.err and ran.code == 1
