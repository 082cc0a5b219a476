"""`demandops import` turns what the reference runs into ordinary demands."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from tests.kit.cli import Ran, Run
from tests.kit.goals import EXPERIMENT, connection
from tests.kit.http import Answer, kubeconfig, serving
from tests.kit.reference import Reference
from tests.kit.repo import GitRepo, books, claims, init, read, tip

REQUEST = "station00/collective-perception-intersection"
"""The request id of all goals in the experiment."""
STATION = "mqtt-connection-station00-edge"


class Migration:
    """The reference after the first steps of the experiment, and a state repo without demands."""

    def __init__(self, folder: Path, demandops: Run, steps: int) -> None:
        folder.mkdir(exist_ok=True)
        self.repo, self.map = init(folder / "state.git"), folder / "map.yaml"
        self.reference, self._demandops = Reference(), demandops
        for path in EXPERIMENT[:steps]:
            self.reference.send(yaml.safe_load(path.read_text()))
        self.files = {path.stem: path for path in self.reference.write(folder / "reference")}

    def run(self, *args: str | Path, named: str = "", stdin: str = "") -> Ran:
        """Run `import` with the reference's files that have ``named`` in their names."""
        chosen = [path for name, path in self.files.items() if named in name]
        how = ["--state-repo", self.repo, "--map", self.map]
        return self._demandops("import", *chosen, *how, *args, stdin=stdin)

    def propose(self, old: str = "", new: str = "") -> None:
        """Let `import` propose a map; set `request` in the map, and replace `old` by `new`."""
        assert self.run().code == 0
        text = self.map.read_text().replace("request: imported", f"request: {REQUEST}")
        assert old in text
        self.map.write_text(text.replace(old, new))

    def request(self, *paths: Path) -> Ran:
        return self._demandops("request", *paths, "--state-repo", self.repo)


@pytest.fixture
def migration(tmp_path: Path, demandops: Run) -> Migration:
    return Migration(tmp_path, demandops, 6)


def ledger(repo: Path) -> dict[str, str]:
    """Return the claim files by path, without the times at which the claims were booked."""
    files = GitRepo(repo).files("ledger/")
    return {path: re.sub("booked: .*", "", files[path]) for path in claims(repo)}


def test_an_imported_ledger_is_that_of_the_demands_themselves(
    tmp_path: Path, demandops: Run, migration: Migration
) -> None:
    migration.propose()
    imported = migration.run()
    assert imported.code == 0, imported.err
    direct = init(tmp_path / "direct.git")
    assert demandops("request", *EXPERIMENT[:6], "--state-repo", direct).code == 0
    assert ledger(migration.repo) == ledger(direct)
    # the fleet's clients go on: a repeated join counts once, and shutdowns release everything
    assert migration.request(EXPERIMENT[3]).out.split()[-3] == "unchanged"
    assert migration.request(*EXPERIMENT[6:]).code == 0
    assert ledger(migration.repo) == {}


def test_counts_alone_end_with_as_many_shutdowns(migration: Migration) -> None:
    migration.propose()
    assert migration.run(named="bookkeeping").code == 0
    assert len(claims(migration.repo, "station00/edge")) == 2
    for path, left in zip(EXPERIMENT[6:], (True, False), strict=True):
        assert migration.request(path).code == 0
        assert bool(books(migration.repo)["connections"]) is left
    assert ledger(migration.repo) == {}


def test_the_same_requesters_twice_are_two_demands(tmp_path: Path, demandops: Run) -> None:
    """The reference counts the requesters twice; under one id DemandOps would count them once."""
    migration = Migration(tmp_path, demandops, 0)
    for topics in (["/t"], ["/t", "/u"]):
        migration.reference.send({"connections": [connection(topics=topics, who=["v"])]})
    migration.files = {path.stem: path for path in migration.reference.write(tmp_path)}
    migration.propose()
    shown = migration.run("--dry-run")
    assert f"Request 0: '{REQUEST}' would be booked" in shown.out
    assert f"Request 1: '{REQUEST}#2' would be booked" in shown.out


def test_the_first_call_proposes_a_map_and_books_nothing(migration: Migration) -> None:
    before = tip(migration.repo)
    proposed = migration.run()
    assert (proposed.code, proposed.err) == (0, "")
    assert proposed.out == (
        f"wrote {migration.map}; nothing is booked\n"
        "  of-edge-object-detection-fusion: edge/object_detection_fusion\n"
        "  mqtt-connection-station00-edge: station00/edge\n"
        "  mqtt-connection-vehicle02-edge: vehicle02/edge\n"
        "  mqtt-connection-vehicle03-edge: vehicle03/edge\n"
        "The reference does not record these ids, so compare each with the id that your clients "
        "send. Fill in the empty fields of the map. Then run the same command with --dry-run.\n"
    )
    assert migration.run("--dry-run").code == 0
    assert tip(migration.repo) == before


def test_a_second_import_changes_nothing(migration: Migration) -> None:
    migration.propose()
    assert migration.run().code == 0
    before = tip(migration.repo)
    again = migration.run("--output", "json")
    assert [row["outcome"] for row in again.json()] == ["unchanged", "unchanged"]
    assert tip(migration.repo) == before


def test_without_the_resources_a_person_fills_in_the_map(migration: Migration) -> None:
    assert migration.run(named="bookkeeping").code == 0
    proposed = yaml.safe_load(migration.map.read_text())
    assert proposed["connections"][STATION] == {
        "id": "station00/edge",
        "source": "station00",
        "target": "edge",
        "broker": "",
        "topics": [{"source": "", "target": ""}],
    }
    refused = migration.run(named="bookkeeping")
    where, told = f"error: {migration.map}:", re.sub(r"(?<=yaml):\d+:", ":", refused.err)
    assert refused.code == 1
    assert told != refused.err
    assert told.splitlines()[:2] == [
        f"{where} applications.of-edge-object-detection-fusion.pointClouds."
        "/station00_local_objectlist.topic: is empty; fill it in",
        f"{where} connections.{STATION}.topics[0].source: is empty; fill it in",
    ]


def test_what_the_map_lacks_is_named(migration: Migration) -> None:
    migration.propose("      /vehicles/vehicle02/ego_data: vehicle02\n")
    refused = migration.run()
    assert refused.code == 1
    assert refused.err == (
        f"error: {migration.map}: applications.of-edge-object-detection-fusion.egoData."
        "/vehicles/vehicle02/ego_data: is missing; add it, or remove the map so that import "
        "proposes a new one\n"
    )


def test_a_broker_and_a_topic_that_only_the_cluster_knows_are_told(migration: Migration) -> None:
    brokers = read(migration.repo, "inventory/brokers.yaml").replace("1993", "1994")
    GitRepo(migration.repo).commit({"inventory/brokers.yaml": brokers})
    goal = connection("vehicle02/edge", ends=("vehicle02", "edge"), topics=["/new"], who=["v"])
    migration.reference.send({"connections": [goal]})
    migration.files = {p.stem: p for p in migration.reference.write(migration.map.parent)}
    told = [line for line in migration.run().err.splitlines() if "vehicle02" in line]
    assert told == [
        "warning: mqtt-connection-vehicle02-edge: its broker service-mqtt-broker-edge:1993 is not "
        "in inventory/brokers.yaml; add the broker there and its node to the map, or leave the "
        "field empty, so that the generator chooses one",
        "warning: mqtt-connection-vehicle02-edge: earlier requests also listed "
        "/vehicles/vehicle02/ego_data; the connection's clients may still carry these topics, so "
        "add the needed ones to the map",
    ]


NO_VERSION = "is not a number; name each request by a version of the resource, like 3"
UNKNOWN = (
    "is no file of the reference; give the bookkeeping and versioning files of the reference's "
    "operators, and its custom resources as `kubectl get -o yaml` prints them"
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "",
            "is empty, perhaps because an operator was stopped while it wrote the file; leave the "
            "file out, or list in it who holds each resource, such as "
            "'mqtt-connection-vehicle00-edge: [vehicle00]'",
        ),
        ("[]", UNKNOWN),
        ("vehicle00: [a]", f"vehicle00: {UNKNOWN}"),
        ("od-a: 1", f"od-a: {UNKNOWN}"),
        (
            "kind: Pod",
            "kind: 'Pod' is not a kind of custom resource that the reference has; known: "
            "MqttConnection, ObjectDetection, ObjectFusion",
        ),
        ("od-a: {'1x': {}}", f"od-a.1x: {NO_VERSION}"),
        (
            f"od-a: {{'{'9' * 30}': {{}}}}",
            f"od-a.{'9' * 30}: {NO_VERSION}",
        ),
        ("od-a: {'1': {requester: [a]}}", "od-a: 1: shutdown: is missing; add it"),
        ("of-a: {topicsEgoData: {}}", "of-a: topicsObjectlist: is missing; add it"),
        (
            "of-edge-object-detection-fusion: [a]",
            "of-edge-object-detection-fusion: appears twice, perhaps from different times; give "
            "it only once",
        ),
    ],
)
def test_what_cannot_be_read_is_refused(migration: Migration, text: str, message: str) -> None:
    refused = migration.run("-", named="fusion_bookkeeping", stdin=text)
    assert refused.code == 1
    assert refused.err == f"error: standard input: {message}\n"
    assert not migration.map.exists()


def test_an_import_that_finds_no_demands_fails(migration: Migration) -> None:
    refused = migration.run("-", named="no such file", stdin="{}")
    assert (refused.code, refused.err) == (
        1,
        "error: nothing to import: "
        "no file or resource names a requester of an application or of a connection\n",
    )
    assert "nothing to import: give FILE or --cluster" in migration.run(named="no such file").err


def test_resources_are_read_from_a_cluster(migration: Migration, tmp_path: Path) -> None:
    items = migration.reference.resources.values()
    plurals = {"mqttconnections": "Mqtt", "objectdetections": "ObjectD", "objectfusions": "ObjectF"}

    def answer(call: object) -> Answer:
        path = str(getattr(call, "path", ""))
        assert path.startswith("/apis/ika.rwth-aachen.de/v1/namespaces/its/"), path
        kind = plurals[path.rpartition("/")[2].partition("?")[0]]
        found = [item for item in items if item["kind"].startswith(kind)]
        return Answer.json({"metadata": {"resourceVersion": "1"}, "items": found})

    with serving(answer) as server:
        access = tmp_path / "clusters.yaml"
        clusters = {"c-its": {"kubeconfig": str(kubeconfig(tmp_path, server.url))}}
        head = {"apiVersion": "demandops/v1", "kind": "ClusterAccess"}
        access.write_text(yaml.safe_dump(head | {"clusters": clusters}))
        where = ["--clusters", access, "--namespace", "its", "--cluster"]
        assert migration.run(*where, "c-its", named="bookkeeping").code == 0
        by_files = migration.map.rename(tmp_path / "by-cluster.yaml").read_text()
        unknown = migration.run(*where, "other", named="bookkeeping")
    assert migration.run().code == 0
    assert yaml.safe_load(by_files) == yaml.safe_load(migration.map.read_text())
    assert (
        "--cluster: 'other' has no kubeconfig in the file of --clusters; "
        "clusters that have one: c-its"
    ) in unknown.err
    away = migration.run(*where, "c-its", named="bookkeeping")
    assert away.code == 1
    assert away.err.startswith("error: cluster c-its: cannot be read: ")
