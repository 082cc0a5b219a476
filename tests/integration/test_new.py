"""The files that `init` and `new` write name their schemas; ``stories/usage.yaml`` has more."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema_rs
import yaml

from tests.kit.cli import Run

OPTIONS = "--input camera=a/msg/B --image r/i:1 --service detector=p/d --service tracker=p/t"
APPLICATION = f"new application tracking {OPTIONS}".split()


def test_an_earlier_library_stays_for_the_charts_that_use_it(
    checkout: Path, demandops: Run
) -> None:
    library = checkout / "appdefs" / "charts" / "ros-service"
    schema = library / "values.schema.json"
    schema.write_text(schema.read_text().replace('"reconfigure"', '"former"'))
    before = {path: path.read_text() for path in library.rglob("*") if path.is_file()}
    assert demandops(*APPLICATION, "-C", checkout).code == 0
    assert before == {path: path.read_text() for path in library.rglob("*") if path.is_file()}
    chart = (checkout / "appdefs/tracking/charts/tracking/Chart.yaml").read_text()
    (used,) = yaml.safe_load(chart)["dependencies"]
    now = checkout / "appdefs" / "charts" / f"ros-service-{used['version']}"
    assert used["repository"] == f"file://../../../charts/{now.name}"
    assert f"\nversion: {used['version']}\n" in (now / "Chart.yaml").read_text()
    again = [word.replace("tracking", "tracing") for word in APPLICATION]
    assert demandops(*again, "-C", checkout).code == 0


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
