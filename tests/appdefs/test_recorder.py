"""Further types of applications need only folders of YAML and templates, and no code.

``tests/scenarios/a-second-type-of-application.yaml`` has a story of them. Demands, a parameter or
an autoscaler decide the number of replicas, as docs/appdef.md says.
"""

from __future__ import annotations

import re
from datetime import timedelta
from pathlib import Path
from typing import Any, Literal

import pytest
from demandops.base.errors import InvalidInput
from demandops.decide.override_report import override_report, warnings
from demandops.decide.planning.planner import affected_keys
from demandops.decide.state import rendered_files, try_configuration
from demandops.model.release import ServiceKey

from tests.kit import plain_yaml
from tests.kit.config import edited, override, skeleton
from tests.kit.memory import NOW, MemoryRepo
from tests.scenarios.running import configuration

ADDITIONS = {
    path: text
    for path, text in configuration(["recorder", "monitor"]).items()
    if path not in skeleton() or path.startswith("registry/")
}
"""The files that a platform engineer adds to a state repo: the appdefs and two registry files."""


def test_no_python_of_the_generator_knows_it() -> None:
    for path in (Path(__file__).parents[2] / "generator").rglob("*.py"):
        text = path.read_text().lower()
        assert "recorder" not in text, path
        assert "object-fusion" not in text, path


def merged(name: str, given: list[object]) -> object:
    """Return what the recorder gets if demands, one after the other, give these values."""
    repo = MemoryRepo(ADDITIONS)
    for minute, value in enumerate(given):
        parameters = {} if value is None else {name: value}
        repo.send(demand(f"d{minute}", **parameters), NOW + timedelta(minutes=minute))
    return values(repo)[name]


@pytest.mark.parametrize("case", plain_yaml.beside(__file__), ids=str)
def test_the_definition_says_how_values_of_several_demands_merge(case: dict[str, Any]) -> None:
    assert repr(merged(case["name"], case["given"])) == repr(case["merged"])
    if case["name"] != "title":  # of several titles, the last one counts
        assert merged(case["name"], case["given"][::-1]) == case["merged"]


# ---- replicas ----


ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "appdef.md").read_text()
APPDEF = "appdefs/recorder/appdef.yaml"
DRIVER = "appdefs/driver/service.yaml"
TEMPLATE = "appdefs/recorder/values/recorder.yaml.j2"
AUTOSCALED = "{min: 2, max: 5, autoscaler: {cpu: 70}}"
BY_REQUESTERS = "{max: 4, per: {requesters: 3}, mayDependOnRequesters: true}"
ROWS = [
    (scaling, int(count or 1), what, size, replicas)
    for scaling, count, what, size, replicas in re.findall(
        r"^\| `(\{.*\})` \| (?:(\d+) )?(\w+)(?: (\w+))? \| (.*) \|$", PAGE, re.MULTILINE
    )
]


def books(scaling: str, *, gitops: Literal["flux", "argocd"] = "flux", **files: str) -> MemoryRepo:
    """Return a state repo whose recorder scales as the YAML text `scaling` says."""
    text = ADDITIONS[APPDEF].replace("{min: 1, max: 3, per: {topics: 2}}", scaling)
    text = text.replace("parameters:\n", "parameters:\n  size: {default: small, merge: union}\n")
    assert scaling in text
    root = {"demandops.yaml": skeleton(gitops)["demandops.yaml"]}
    domains = "policy/access-domains.yaml"  # a put may name other requesters than the one before
    root[domains] = skeleton()[domains].replace(
        '    nodes: ["*"]\n', '    nodes: ["*"]\n    rules: [{name: all, manages: ["*"]}]\n'
    )
    return MemoryRepo({**ADDITIONS, **root, APPDEF: text, **files})


def demand(
    name: str = "d", *, topics: int = 1, sources: int = 1, requesters: int = 1, **parameters: object
) -> dict[str, Any]:
    nodes = ["vehicle00", "vehicle01", "station00"]
    clouds = [
        {"topic": f"/points_{number}", "source": nodes[number % sources]}
        for number in range(max(topics, sources))
    ]
    app = {"id": "edge/record", "type": "recorder", "node": "edge", "parameters": parameters}
    who = [f"{name}-{number}" for number in range(requesters)]
    app |= {"inputs": {"point_cloud": clouds}, "connect": "none"}
    return {"kind": "Demand", "demand": name, "requesters": who, "applications": [app]}


def release(repo: MemoryRepo) -> dict[str, Any]:
    """Return the recorder's HelmRelease or, with Argo CD, the recorder's Application."""
    (path,) = (path for path in repo.rendered() if "/rec-" in path)
    found: dict[str, Any] = plain_yaml.load(repo.files[path])
    return found


def values(repo: MemoryRepo) -> dict[str, Any]:
    return dict(release(repo)["spec"]["values"])


def fact(repo: MemoryRepo) -> str:
    """Return what the commit message says about the recorder's replicas."""
    (found,) = (plan for plan in repo.state.plans.values() if plan.name.startswith("rec-"))
    (told,) = (line for line in found.facts() if line.startswith("replicas "))
    return told.removeprefix("replicas ")


def test_the_page_has_a_row_for_each_way() -> None:
    ways = ("topics", "sources", "claims", "requesters", "sizes", "autoscaler")
    assert all(any(way in row[0] for row in ROWS) for way in ways)


@pytest.mark.parametrize(("scaling", "count", "what", "size", "replicas"), ROWS)
def test_a_demand_gets_the_replicas_of_the_page(
    scaling: str, count: int, what: str, size: str, replicas: str
) -> None:
    repo = books(scaling)
    if what == "claims":
        for number in range(count):
            repo.send(demand(f"d{number}"))
    else:
        repo.send(demand(**{what: size} if size else {what: count}))
    assert fact(repo) == replicas


def test_the_page_shows_the_template_that_serves_both() -> None:
    start = "{% if autoscaler is defined %}"
    shown = PAGE[PAGE.index(start) : PAGE.index("{% endif %}", PAGE.index(start))]
    text = re.sub("^    ", "", shown, flags=re.MULTILINE)
    for path in (ROOT / "appdefs" / "object-detection-fusion" / "values").iterdir():
        assert text in path.read_text(), path.name


@pytest.mark.parametrize(
    ("scaling", "selected", "requesters", "files", "services"),
    [
        (BY_REQUESTERS, [], 4, 1, {"recorder", "driver"}),
        ("{max: 4, per: {topics: 2}}", [], 9, 0, {"recorder"}),
        ("{min: 1}", ["d-1"], 2, 3, {"recorder", "driver"}),
    ],
    ids=["the definition depends on them", "nothing does", "an override selects them"],
)
def test_a_change_of_requesters_replans_only_what_depends_on_them(
    scaling: str, selected: list[str], requesters: int, files: int, services: set[str]
) -> None:
    select = {"requesters": selected, "services": ["driver"]}
    overrides = {"overrides/tested.yaml": override(select, replicas=0)} if selected else {}
    managing = "    rules: [{name: all, requesters: ['*'], manages: ['*']}]\n    namespace:"
    policy = edited("policy/access-domains.yaml", "    namespace:", managing)
    repo = books(scaling, **overrides, **policy)
    repo.send(demand(topics=3, requesters=requesters - 1))
    for count in (requesters, requesters - 1):
        before = repo.state
        decision = repo.send(demand(topics=3, requesters=count))
        keys = affected_keys(before, decision.state, decision.changes.claims)
        assert {key.service for key in keys if isinstance(key, ServiceKey)} == services
        again = rendered_files(decision.state)
        assert {path: repo.files[path] for path in again} == again
        assert sum(path.startswith("clusters/") for path in decision.files) == files


def test_argo_cd_leaves_the_number_of_an_autoscaler_alone() -> None:
    repo = books(AUTOSCALED, gitops="argocd")
    repo.send(demand())
    spec = release(repo)["spec"]
    (ignored,) = spec["ignoreDifferences"]
    assert (ignored["kind"], ignored["jsonPointers"]) == ("Deployment", ["/spec/replicas"])
    assert "RespectIgnoreDifferences=true" in spec["syncPolicy"]["syncOptions"]
    of_driver, _ = sorted(repo.objects("Application").items())
    assert "ignoreDifferences" not in of_driver[1]["spec"]


STOPPED = {
    f"overrides/o{replicas}.yaml": override(
        {"services": ["recorder"]}, priority=3 - replicas, replicas=replicas
    )
    for replicas in (0, 3)
}
ONLY_REPLICAS = {TEMPLATE: ADDITIONS["appdefs/driver/values/driver.yaml.j2"]}


@pytest.mark.parametrize(
    ("files", "place", "told"),
    [
        (STOPPED, "overrides/o0.yaml: replicas: ", "'deny' instead"),
        (ONLY_REPLICAS, f"{TEMPLATE}:1: ", "'replicas' is undefined"),
    ],
    ids=["an override that stops it", "a template that knows only replicas"],
)
def test_what_does_not_go_with_an_autoscaler_is_a_fault(
    files: dict[str, str], place: str, told: str
) -> None:
    repo = books(AUTOSCALED, **files)
    for render in (
        lambda: repo.send(demand()),
        lambda: try_configuration(repo.state),
    ):
        with pytest.raises(InvalidInput) as invalid:
            render()
        assert str(invalid.value).startswith(place)
        assert told in str(invalid.value)


def doubled(**changed: str) -> list[tuple[str, str]]:
    repo = MemoryRepo(ADDITIONS | changed)
    repo.send(demand())
    return [*warnings(override_report(repo.state, NOW))]


def test_a_warning_says_what_an_override_publishes_twice() -> None:
    """The override runs two replicas of the driver and of the recorder.

    The second replica doubles what the driver publishes, unless the replicas divide the work. The
    recorder publishes nothing, so no warning names it.
    """
    two = {"overrides/two.yaml": override({"services": ["*"]}, replicas=2)}
    ((path, told),) = doubled(**two)
    assert path == "overrides/two.yaml"
    assert told.startswith("runs 2 replicas of driver, and each replica publishes every output")
    divided = ADDITIONS[DRIVER] + "scaling: {dividesWork: true}\n"
    assert doubled(**two, **{DRIVER: divided}) == []
    taken_away = override({"services": ["driver"]}, replicas=1, priority=1)
    assert doubled(**two, **{"overrides/one.yaml": taken_away}) == []
