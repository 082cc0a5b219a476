"""The generator's chart: helm and the API server accept it, and its pods work with the real API.

The cluster's nodes are simulated. So these tests start each pod's container as a kubelet would:
from the pod's spec in the API, with its volumes, its user, and a token of its account.
"""

from __future__ import annotations

import base64
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.e2e.common.expected import demand
from tests.e2e.common.pod import Pod
from tests.e2e.common.rendered import check_chart
from tests.e2e.common.world import demandops
from tests.e2e.rig import githttp
from tests.e2e.rig.cluster import Rig, git_server
from tests.e2e.rig.kube import build_manifest
from tests.e2e.rig.net import free_port, url
from tests.kit.repo import git, hook, keygen
from tests.kit.ros import Client

pytestmark = pytest.mark.only("flux", "the generator's chart does not depend on the controller")

CHART = Path(__file__).parents[2] / "deploy" / "chart"
RELEASE, NAMESPACE = "generator", "demandops"
GIT = "git-of-the-chart"
USER, PASSWORD = "robot", "a token of the git server"
VALUES: dict[str, Any] = yaml.safe_load(Path(__file__).with_name("deployment.yaml").read_text())
NEEDED = VALUES["needed"]


@pytest.fixture(scope="module", autouse=True)
def namespace(rig: Rig) -> Iterator[None]:
    rig.kube.apply(build_manifest("v1", "Namespace", NAMESPACE))
    yield
    rig.kube.delete("Namespace", NAMESPACE)


@pytest.mark.parametrize(
    "values",
    [NEEDED, NEEDED | {"replicas": 1}, VALUES["all"]],
    ids=["as it comes", "one pod", "all set"],
)
def test_the_chart_passes_lint_and_what_it_gives_the_server(
    rig: Rig, tmp_path: Path, values: dict[str, Any]
) -> None:
    kinds = check_chart(rig, CHART, RELEASE, NAMESPACE, values, tmp_path)
    assert ({"Lease", "Role", "RoleBinding"} <= kinds) == (values.get("replicas") != 1)
    assert ("Service" in kinds) == ("secrets" in values)


@pytest.mark.parametrize("missing", ["stateRepo", "image"])
def test_the_chart_is_refused_without_what_it_needs(rig: Rig, tmp_path: Path, missing: str) -> None:
    values = {key: NEEDED[key] for key in NEEDED if key != missing}
    with pytest.raises(Exception, match=missing):
        check_chart(rig, CHART, RELEASE, NAMESPACE, values, tmp_path, lint=False)


def leads(pod: Pod) -> bool:
    return pod.code is None and "taking demands on" in pod.text()


class Deployed:
    """The installed chart, with a state repo on a Git server that requires a user and password."""

    def __init__(self, rig: Rig, folder: Path, ros_domain: int) -> None:
        self.rig, self.folder, port = rig, folder, free_port()
        self.repository = folder / "git" / "state.git"
        self.repository.parent.mkdir()
        address = f"{url(port)}/state.git"
        demandops(folder, "init", str(self.repository), "--bare", "--url", address)
        git(self.repository, "config", "http.receivepack", "true")
        secrets = {githttp.USER_VARIABLE: USER, githttp.PASSWORD_VARIABLE: PASSWORD}
        rig.parts.start_together([git_server(GIT, self.repository.parent, port, secrets)])
        self.private_key = keygen(folder / "key").read_text()
        self._secret("git", username=USER, password=PASSWORD)
        self._secret("signing", **{"ssh-privatekey": self.private_key})
        self.values: dict[str, Any] = {
            **NEEDED,
            "stateRepo": address,
            "secrets": {"git": "git", "signing": "signing"},
            "ros": {
                "domainId": ros_domain,
                "env": [{"name": "ROS_AUTOMATIC_DISCOVERY_RANGE", "value": "LOCALHOST"}],
            },
        }
        self.install()
        server = yaml.safe_load(rig.kubeconfig.read_text())["clusters"][0]["cluster"]["server"]
        address, names = server.removeprefix("https://"), (f"{RELEASE}-0", f"{RELEASE}-1")
        self.pods = [Pod(rig.kube, name, NAMESPACE, address, folder) for name in names]
        self.start(*self.pods)

    def install(self) -> None:
        given = self.folder / "values.json"
        given.write_text(json.dumps(self.values))
        options = ["--install", f"--namespace={NAMESPACE}", f"--values={given}"]
        self.rig.helm("upgrade", RELEASE, str(CHART), *options)

    def start(self, *pods: Pod) -> None:
        """Start the containers of the pods; wait until each pod is the leader or a standby."""
        for pod in pods:
            pod.start()
        for pod in pods:
            pod.wait_text("taking demands on", "standing by")

    def by_role(self) -> tuple[Pod, Pod]:
        """Return the leader, which serves the ROS actions, and the pod that stands by."""
        active, standby = sorted(self.pods, key=leads, reverse=True)
        assert leads(active) and not leads(standby)
        return active, standby

    def lease_holder(self) -> str:
        lease = self.rig.kube.get("Lease", RELEASE, NAMESPACE)
        assert lease is not None
        return str((lease.get("spec") or {})["holderIdentity"])

    def subjects(self) -> str:
        return git(self.repository, "log", "--format=%s", "main")

    def close(self) -> None:
        for pod in self.pods:
            pod.kill()
        self.rig.helm("uninstall", RELEASE, f"--namespace={NAMESPACE}")
        self.rig.parts.stop(GIT)

    def _secret(self, name: str, **data: str) -> None:
        encoded = {key: base64.b64encode(value.encode()).decode() for key, value in data.items()}
        self.rig.kube.apply(build_manifest("v1", "Secret", name, NAMESPACE, data=encoded))


@pytest.fixture(scope="module")
def deployed(
    rig: Rig, ros_domain: int, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Deployed]:
    if os.geteuid():
        pytest.skip("only root can start a container")
    folder = tmp_path_factory.mktemp("deployed")
    for parent in (folder, *folder.parents):  # the pod's user must reach them
        if parent.owner() == "root" and parent != Path("/tmp"):
            parent.chmod(parent.stat().st_mode | 0o011)
    made = Deployed(rig, folder, ros_domain)
    yield made
    made.close()


def test_one_pod_answers_with_signed_commits(deployed: Deployed, client: Client) -> None:
    client.ready()
    sent = client.call(demand(1))
    assert sent.status == "succeeded", sent.message
    assert "gpgsig" in git(deployed.repository, "cat-file", "commit", sent.commit)
    deployed.by_role()
    assert len(deployed.lease_holder()) > 36


def test_a_pod_has_neither_privileges_nor_secrets_in_sight(deployed: Deployed) -> None:
    for pod in deployed.pods:
        process = Path("/proc", str(pod.pid))
        status = dict(line.split(":\t", 1) for line in (process / "status").open() if ":\t" in line)
        assert status["Uid"].split() == 4 * ["10001"]
        assert int(status["CapEff"], 16) == int(status["CapBnd"], 16) == 0
        with pytest.raises(OSError, match="Read-only file system"):
            (process / "root" / "written").touch()
        shown = [json.dumps(pod.manifest), pod.text()]
        shown += [(process / file).read_text() for file in ("cmdline", "environ")]
        for secret in (PASSWORD, deployed.private_key.splitlines()[1]):
            assert not [text for text in shown if secret in text]


def test_the_account_may_renew_the_lease_and_nothing_else(deployed: Deployed) -> None:
    rules = deployed.rig.kube.rules(RELEASE, NAMESPACE)
    own = [rule for rule in rules if not rule["resources"][0].startswith("selfsubject")]
    assert own == [
        {
            "apiGroups": ["coordination.k8s.io"],
            "resources": ["leases"],
            "resourceNames": [RELEASE],
            "verbs": ["get", "update"],
        }
    ]


def test_a_killed_pod_is_replaced_and_stands_by_when_it_returns(
    deployed: Deployed, client: Client
) -> None:
    active, standby = deployed.by_role()
    active.kill()
    standby.wait_text("taking demands on")
    client.ready()
    sent = client.call(demand(2))
    assert sent.status == "succeeded", sent.message
    deployed.start(active)
    assert deployed.by_role() == (standby, active)


def test_a_pod_that_returns_hands_in_its_journal_before_it_stands_by(
    deployed: Deployed, client: Client
) -> None:
    active, standby = deployed.by_role()
    before = deployed.subjects()
    deployed.rig.parts.kill(GIT)
    sent = client.send(demand(3))
    client.wait(lambda: "waiting:" in sent.stages)
    active.kill()
    standby.wait_text("taking demands on")
    deployed.rig.parts.start(GIT)
    assert deployed.subjects() == before, "the other pod must not have booked the demand"
    # else the push would win against a wrong order, too
    slow = hook(deployed.repository, "pre-receive", "sleep 5")
    deployed.start(active)
    slow.unlink()
    assert deployed.subjects() != before
    assert "resuming demand" in active.text()
    assert deployed.by_role() == (standby, active)


def test_an_upgrade_leaves_the_lease_to_its_holder(deployed: Deployed) -> None:
    active, _ = deployed.by_role()
    holder = deployed.lease_holder()
    deployed.values |= {"fetchInterval": "10s"}
    deployed.install()
    assert deployed.lease_holder() == holder
    assert active.code is None
