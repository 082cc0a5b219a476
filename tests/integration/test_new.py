"""`demandops new` writes valid files, and its example demand can be booked."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jsonschema_rs
import yaml
from demandops import __version__

from tests.kit.cli import Run
from tests.kit.repo import GitRepo, git

OPTIONS = (
    "--input camera=sensor_msgs/msg/Image --input ego=my_msgs/msg/Ego "
    "--image registry.example/tracking:1.0.0 --service detector=tracking/detector "
    "--service multi-tracker=tracking/tracker.launch.py"
)
APPLICATION = f"new application tracking {OPTIONS}".split()


def read(path: Path) -> Any:
    return yaml.safe_load(path.read_text())


def test_an_application_passes_check_at_once_and_its_example_demand_runs(
    checkout: Path, demandops: Run, tmp_path: Path
) -> None:
    ran = demandops(*APPLICATION, "-C", checkout, "--output", "json")
    assert (ran.code, ran.err) == (0, "")
    changed = git(checkout, "status", "--porcelain", "--untracked-files=all").splitlines()
    assert [line.split() for line in changed] == [["??", path] for path in ran.json()["files"]]
    checked = demandops("check", checkout)
    assert (checked.code, checked.err) == (0, "")
    assert "_charts/tracking-0.1.0.yaml" in checked.out
    git(checkout, "add", "--all")
    git(checkout, "commit", "--quiet", "--message=Add tracking")
    git(tmp_path, "clone", "--quiet", "--bare", str(checkout), "fleet.git")
    demand = checkout / "appdefs" / "tracking" / "demand.yaml"
    for dry in (["--dry-run"], []):
        ran = demandops("request", *dry, demand, "--state-repo", tmp_path / "fleet.git")
        assert (ran.code, ran.err) == (0, "")
    files = GitRepo(tmp_path / "fleet.git").manifests()
    (detector,), (tracker,) = (
        [path for path in files if f"/{name}-" in path] for name in ("detector", "multitra")
    )
    made = "/edge_tracking_detector"
    values = [yaml.safe_load(files[path])["spec"]["values"] for path in (detector, tracker)]
    names = [
        "detector_edge_tracking_" + detector[-17:-5],
        "multitra_edge_tracking_" + tracker[-17:-5],
    ]
    assert [one["node"]["name"] for one in values] == names
    assert [one["parameters"] for one in values] == [
        {
            names[0]: {
                "camera_topics": ["/camera"],
                "ego_topics": ["/ego"],
                "result_topic": made,
            }
        },
        {
            names[1]: {
                "detector_topics": [made],
                "result_topic": "/edge_tracking_multi_tracker",
            }
        },
    ]
    image = {"repository": "registry.example/demandops", "tag": __version__, "digest": ""}
    assert [one["parameterSync"]["image"] for one in values] == [image, image]


def test_a_vehicle_more_and_a_parameter_only_reconfigure(
    checkout: Path, demandops: Run, tmp_path: Path
) -> None:
    assert demandops(*APPLICATION, "-C", checkout).code == 0
    definition = checkout / "appdefs" / "tracking" / "appdef.yaml"
    text = definition.read_text()
    definition.write_text(text + "parameters:\n  rate_hz: {default: 10, merge: max}\n")
    git(checkout, "add", "--all")
    git(checkout, "commit", "--quiet", "--message=Add tracking")
    bare = tmp_path / "fleet.git"
    git(tmp_path, "clone", "--quiet", "--bare", str(checkout), bare.name)
    demand = checkout / "appdefs" / "tracking" / "demand.yaml"
    assert demandops("demand", demand, "--state-repo", bare).code == 0
    changed = read(demand)
    (asked,) = changed["applications"]
    asked["inputs"]["camera"].append({"topic": "/camera2", "source": "edge"})
    asked["parameters"] = {"rate_hz": 20}
    demand.write_text(json.dumps(changed))
    ran = demandops("demand", "--dry-run", demand, "--state-repo", bare)
    assert ran.out.count(", reconfigures") == 2 and "restarts" not in ran.out, ran.out


def test_an_older_library_is_named_before_anything_is_written(
    checkout: Path, demandops: Run
) -> None:
    schema = checkout / "appdefs" / "charts" / "ros-service" / "values.schema.json"
    schema.write_text(schema.read_text().replace('"reconfigure"', '"former"'))
    ran = demandops(*APPLICATION, "-C", checkout)
    assert ran.code != 0 and "appdefs/charts/ros-service is of an earlier version" in ran.err
    assert not (checkout / "appdefs" / "tracking").exists()


def test_every_file_that_people_write_names_its_schema(demandops: Run, tmp_path: Path) -> None:
    repo = tmp_path / "fleet"
    assert demandops("init", repo).code == 0
    assert demandops(*APPLICATION, "-C", repo).code == 0
    written = [
        path
        for top in ("inventory", "policy", "registry", "appdefs")
        for path in (repo / top).rglob("*.yaml")
        if top != "appdefs" or "charts" not in path.parts
    ]
    assert len(written) >= 12
    for path in (repo / "demandops.yaml", *written):
        first = path.read_text().splitlines()[0]
        mark, _, place = first.partition("$schema=")
        assert mark == "# yaml-language-server: ", path
        valid = jsonschema_rs.validator_for(json.loads((path.parent / place).read_text())).is_valid
        assert valid(read(path)) and not valid(read(path) | {"misspelt": 1}), path


def test_outputs_are_named_in_the_definition(demandops: Run, tmp_path: Path) -> None:
    ran = demandops(*APPLICATION, "-C", tmp_path, "--output", "spots=std_msgs/msg/Int32")
    assert (ran.code, "list outputs of services in appdef.yaml" in ran.err) == (2, True)
