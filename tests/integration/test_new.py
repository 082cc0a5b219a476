"""`demandops new` writes valid files, and its example demand can be booked."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema_rs
import pytest
import yaml

from tests.kit.cli import Run
from tests.kit.repo import git

OPTIONS = [
    *("--input", "camera=sensor_msgs/msg/Image", "--input", "ego=my_msgs/msg/Ego"),
    *("--image", "registry.example/tracking:1.0.0"),
    *("--service", "detector=tracking/detector.launch.py"),
    *("--service", "multi-tracker=tracking/tracker.launch.py"),
]
APPLICATION = ["new", "application", "tracking", *OPTIONS]


@pytest.fixture
def laid(checkout: Path, demandops: Run) -> Path:
    """Return a state repo in which a new application is committed."""
    assert demandops(*APPLICATION, "-C", checkout).code == 0
    git(checkout, "add", "--all")
    git(checkout, "commit", "--quiet", "--message=Add tracking")
    return checkout


def test_an_application_passes_check_at_once(checkout: Path, demandops: Run) -> None:
    ran = demandops(*APPLICATION, "-C", checkout, "--output", "json")
    files = ran.json()["files"]
    assert (ran.code, ran.err) == (0, "")
    changed = git(checkout, "status", "--porcelain", "--untracked-files=all").splitlines()
    assert [line.split() for line in changed] == [["??", path] for path in files]
    checked = demandops("check", checkout)
    assert (checked.code, checked.err) == (0, "")
    assert "_charts/tracking-0.1.0.yaml" in checked.out


def test_its_example_demand_runs(laid: Path, demandops: Run, tmp_path: Path) -> None:
    bare = tmp_path / "fleet.git"
    git(tmp_path, "clone", "--quiet", "--bare", str(laid), str(bare))
    demand = laid / "appdefs" / "tracking" / "demand.yaml"
    dry = demandops("request", "--dry-run", demand, "--state-repo", bare)
    assert (dry.code, dry.err) == (0, "")
    assert demandops("request", demand, "--state-repo", bare).code == 0
    tree = git(bare, "ls-tree", "-r", "--name-only", "main", "clusters/")
    (detector,) = [path for path in tree.splitlines() if "/detector-" in path]
    (tracker,) = [path for path in tree.splitlines() if "/multitra-" in path]
    values = [
        yaml.safe_load(git(bare, "show", f"main:{path}"))["spec"]["values"]
        for path in (detector, tracker)
    ]
    made = "/edge_tracking_detector"
    assert [one["launch"]["arguments"] for one in values] == [
        {
            "node_name": "detector_edge_tracking_" + detector[-17:-5],
            "camera_topics": "/camera",
            "ego_topics": "/ego",
            "result_topic": made,
        },
        {
            "node_name": "multitra_edge_tracking_" + tracker[-17:-5],
            "detector_topics": made,
            "result_topic": "/edge_tracking_multi_tracker",
        },
    ]


def test_a_fleet_from_nothing(demandops: Run, tmp_path: Path) -> None:
    repo = tmp_path / "fleet"
    assert demandops("init", repo, "--example", "none").code == 0
    ran = demandops(*APPLICATION, "-C", repo)
    assert (ran.code, ran.out) == (1, "")
    assert "add one first, in inventory/nodes.yaml" in ran.err
    nodes = [{"id": id, "type": "edge", "cluster": "site"} for id in ("edge00", "edge01")]
    for path, kind, entries in (
        ("clusters/site", "Clusters", [{"name": "site"}]),
        ("nodes/edges", "Nodes", nodes),
    ):
        file = repo / "inventory" / f"{path}.yaml"
        file.parent.mkdir()
        data = {"apiVersion": "demandops/v1", "kind": kind, kind.lower(): entries}
        file.write_text(yaml.safe_dump(data))
    assert demandops(*APPLICATION, "-C", repo).code == 0
    ran = demandops("check", repo)
    assert (ran.code, ran.err) == (0, "")


def test_the_example_is_demanded_by_whom_the_rules_allow(checkout: Path, demandops: Run) -> None:
    policy = checkout / "policy" / "access-domains.yaml"
    rule = "    rules: [{name: cars, requesters: ['vehicle*']}]\n"
    policy.write_text(policy.read_text().rstrip("\n") + "\n" + rule)
    assert demandops(*APPLICATION, "-C", checkout).code == 0
    demand = yaml.safe_load((checkout / "appdefs" / "tracking" / "demand.yaml").read_text())
    assert demand["requesters"] == ["vehicle00"]


def test_rules_that_do_not_allow_the_application_are_told(checkout: Path, demandops: Run) -> None:
    policy = checkout / "policy" / "access-domains.yaml"
    rule = "    rules: [{name: cars, requesters: ['vehicle*'], applications: ['object-*']}]\n"
    policy.write_text(policy.read_text().rstrip("\n") + "\n" + rule)
    ran = demandops(*APPLICATION, "-C", checkout)
    assert ran.code == 0
    assert (
        "no rule of access domain 'perception' allows demands for this application on edge; to "
        "allow them, widen a rule, such as 'cars', in policy/access-domains.yaml\n"
    ) in ran.out
    demand = yaml.safe_load((checkout / "appdefs" / "tracking" / "demand.yaml").read_text())
    assert demand["requesters"] == ["vehicle00"]


def test_an_override(checkout: Path, demandops: Run) -> None:
    select = ["--service", "object-detection", "--node", "edge"]
    why = ["--reason", "a test", "--owner", "petra", "-C", checkout]
    assert demandops("new", "override", "quiet", *select, "--deny", *why).code == 0
    assert demandops("new", "override", "none", *select, "--replicas", "0", *why).code == 0
    found = yaml.safe_load((checkout / "overrides" / "quiet.yaml").read_text())
    assert found["select"] == [{"services": ["object-detection"], "nodes": ["edge"]}]
    assert found["deny"] is True
    assert demandops("check", checkout).code == 0


@pytest.mark.parametrize(
    ("args", "code", "told"),
    [
        (
            ["new", "application", "object-detection-fusion", *OPTIONS],
            1,
            "error: NAME: 'object-detection-fusion' exists already; choose another name",
        ),
        (["new", "application", "../x", *OPTIONS], 1, "error: NAME: '../x' cannot be used here"),
        (
            ["new", "application", "Big_Name", *OPTIONS],
            1,
            "error: NAME: 'Big_Name' cannot be used here; write lower-case letters, digits and '-' "
            "between them, such as c-its\n",
        ),
        ([*APPLICATION[:-1], "tracker=launch"], 2, "'tracker=launch' is not NAME=PACKAGE/FILE"),
        (["new", "application", "x"], 2, "Missing options '--input', '--service', '--image'."),
        (
            ["new", "application", "object-detection-fusion"],
            1,
            "error: NAME: 'object-detection-fusion' exists already; choose another name",
        ),
        (
            ["new", "application", "x", *OPTIONS, "--input", "camera=sensor_msgs/Image"],
            2,
            "write camera=sensor_msgs/msg/Image",
        ),
        (
            [
                "new",
                "override",
                "../x",
                "--reason",
                "r",
                "--owner",
                "o",
                "--node",
                "edge",
                "--hold",
            ],
            1,
            "error: ",
        ),
    ],
)
def test_what_cannot_be_is_refused_and_nothing_is_written(
    checkout: Path, demandops: Run, args: list[str], code: int, told: str
) -> None:
    ran = demandops(*args, "-C", checkout)
    assert (ran.code, ran.out) == (code, "")
    assert told in ran.err
    assert git(checkout, "status", "--porcelain") == ""
    assert not (checkout.parent / "x.yaml").exists()


def test_every_file_that_people_write_names_its_schema(demandops: Run, tmp_path: Path) -> None:
    repo = tmp_path / "fleet"
    assert demandops("init", repo).code == 0
    assert demandops(*APPLICATION, "-C", repo).code == 0
    written = [
        path
        for top in ("inventory", "policy", "registry", "appdefs")
        for path in (repo / top).rglob("*.yaml")
        if "charts" not in path.relative_to(repo).parts[1:-1]
        or path.relative_to(repo).parts[:2] == ("registry", "charts")
    ]
    assert len(written) >= 12
    for path in (repo / "demandops.yaml", *written):
        first = path.read_text().splitlines()[0]
        mark, _, place = first.partition("$schema=")
        assert mark == "# yaml-language-server: ", path
        schema = json.loads((path.parent / place).read_text())
        validator = jsonschema_rs.validator_for(schema)
        assert validator.is_valid(yaml.safe_load(path.read_text())), path
