"""The files that `init` and `new` write name their schemas; ``stories/usage.yaml`` has more."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema_rs
import yaml

from tests.kit.cli import Run
from tests.kit.repo import git

OPTIONS = "--input camera=a/msg/B --image r/i:1 --service detector=p/d --service tracker=p/t"
APPLICATION = f"new application tracking {OPTIONS}".split()


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
    changed = yaml.safe_load(demand.read_text())
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
        content = yaml.safe_load(path.read_text())
        assert valid(content) and not valid(content | {"misspelt": 1}), path
