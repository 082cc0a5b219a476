"""Mistakes that people make in the configuration of a state repo, and what is warned of.

``config-mistakes.yaml`` lists the mistakes, and ``tests/unit/messages`` has the message for each.
``test_mistakes_anywhere`` tries every mistake that a JSON schema can find.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from demandops.base.errors import Fault, InvalidInput
from demandops.decide import warnings
from demandops.model.config.load import load

from tests.kit import plain_yaml
from tests.kit.config import configuration, skeleton, state_of
from tests.kit.connections import demand, routes
from tests.kit.goals import put
from tests.kit.memory import MemoryRepo

ROOT, NODES = "demandops.yaml", "inventory/nodes.yaml"
APPDEF = "appdefs/object-detection-fusion/appdef.yaml"
Files = Mapping[str, str | None]

_LISTED = plain_yaml.beside(__file__, "config-mistakes")
_EXAMPLES = Path(__file__).parents[3] / "examples"
_OF_A_CLUSTER = {
    "appdefs/map-server/service.yaml": (_EXAMPLES / "map-server" / "service.yaml").read_text()
}
_BASES: Mapping[str, Mapping[str, Any]] = {
    **_LISTED["bases"],
    "a service for a cluster": _OF_A_CLUSTER | _LISTED["bases"]["a service for a cluster"],
    "Argo CD": {ROOT: skeleton("argocd")[ROOT]},
    "a second definition": {
        path.replace("object-detection-fusion/", "copy/", 1): text
        for path, text in skeleton().items()
        if path.startswith("appdefs/object-detection-fusion/") and "/charts/" not in path
    },
}


def changed(mistake: Mapping[str, Any]) -> dict[str, str | None]:
    """Return the files that differ from the skeleton."""
    files: dict[str, str | None] = {}
    for layer in (_BASES.get(mistake.get("base", ""), {}), mistake):
        for path, change in layer.items():
            if path == "scaling":
                scaling = {"prefix: of": f"…\n    scaling: {json.dumps(change)}"}
                files[APPDEF] = _edited(files.get(APPDEF) or skeleton()[APPDEF], scaling)
            elif isinstance(change, dict):
                files[path] = _edited(files.get(path) or skeleton()[path], change)
            elif path != "base":
                files[path] = change
    return files


def _edited(text: str, edits: Mapping[str, str]) -> str:
    for old, new in edits.items():
        assert old in text
        text = text.replace(old, new.replace("…", old), 1)
    return text


MISTAKES: Mapping[str, Files] = {
    name: changed(mistake) for name, mistake in _LISTED["mistakes"].items()
}


def refused(changed: Files) -> tuple[Fault, ...]:
    """Return the faults of a configuration that must be refused."""
    with pytest.raises(InvalidInput) as invalid:
        load(configuration(changed))
    return invalid.value.faults


NEEDED = [
    *(ROOT, NODES, "policy/access-domains.yaml", "registry/charts.yaml", "registry/images.yaml"),
    *("inventory/clusters.yaml", "inventory/brokers.yaml"),
]


@pytest.mark.parametrize("content", [None, "", "- a\n", "a: [\n"])
def test_a_file_of_no_use_is_one_fault(content: str | None) -> None:
    for path in NEEDED:
        (found,) = refused({path: content})
        assert found.file == path


@pytest.mark.parametrize("name", _LISTED["valid"])
def test_an_odd_but_valid_configuration_loads(name: str) -> None:
    load(configuration(changed(_LISTED["valid"][name])))


# ---- warnings in a valid configuration, and in a demand ----


CASES = plain_yaml.beside(__file__, "policy-warnings")
MISSPELLED = plain_yaml.beside(__file__, "misspelled-topics")
REQUESTS = plain_yaml.beside(__file__, "request-warnings")


def told(case: dict[str, Any]) -> list[str]:
    files = {path: change for path, change in case.items() if path != "warns"}
    state = MemoryRepo(changed(files)).state
    patterns = warnings.unmatched_pattern_warnings(state.config)
    return [str(one) for one in (*patterns, *warnings.policy_warnings(state))]


@pytest.mark.parametrize("name", CASES)
def test_exactly_what_is_listed_is_warned_of(name: str) -> None:
    found = told(CASES[name])
    for words, one in zip(CASES[name]["warns"], found, strict=True):
        assert words in one


@pytest.mark.parametrize("name", REQUESTS)
def test_requests_that_no_node_or_pod_has_are_told(name: str) -> None:
    case = {key: part for key, part in REQUESTS[name].items() if key not in ("warns", "requests")}
    appdef = {"prefix: of": f"…\n    requests: {json.dumps(REQUESTS[name]['requests'])}"}
    files = configuration(changed({**case, APPDEF: appdef}))
    found = map(str, warnings.request_warnings(load(files)))
    for words, one in zip(REQUESTS[name]["warns"], found, strict=True):
        assert words in one


@pytest.mark.parametrize(("live", "changes", "words"), plain_yaml.beside(__file__, "live-warnings"))
def test_a_live_value_that_does_not_exist_is_told(
    live: str, changes: dict[str, Any], words: list[str]
) -> None:
    state = MemoryRepo(changed({**changes, APPDEF: {"live: [inputs]": f"live: [{live}]"}})).state
    told = [*map(str, warnings.live_warnings(state))]
    assert len(told) == bool(words)
    for text in told:
        assert text.startswith(f"{APPDEF}: services.object-fusion.live: ")
        assert all(word in text for word in words), text


def test_connections_that_could_not_be_demanded_any_longer_are_told() -> None:
    books = MemoryRepo(changed({"base": "two domains"}))
    books.send(routes(demand()))
    closed = {"base": "two domains", "policy/access-domains.yaml": {"peers: [": "nodes: ["}}
    config = load(configuration(changed(closed)))
    found = map(str, warnings.policy_warnings(state_of(config, books.state.ledger)))
    (told,) = [one for one in found if "no rule of access domain 'fleet' has 'city' among" in one]
    assert told.endswith("claims on such connections stay in effect: 1")


@pytest.mark.parametrize("role", ["point_cloud", "ego_data", ""])
@pytest.mark.parametrize(("source", "topic", "known", "meant"), MISSPELLED)
def test_a_topic_is_told_if_it_is_probably_a_misspelling_of_a_known_one(
    source: str, topic: str, known: list[str], meant: str, role: str
) -> None:
    """As an input of an application, and on a connection alone."""
    books = MemoryRepo()
    for number, one in enumerate([*known, topic]):
        link = {"id": f"c{number}", "source": source, "target": "edge", "topics": [{"source": one}]}
        demand = put(f"d{number}", applications=[], connections=[link])
        if role:
            demand = put(f"d{number}")
            demand["applications"][0]["inputs"] = {role: [{"topic": one, "source": source}]}
        decision = books.send(demand)
    told = f"'{source}' is not known to publish {topic}; did you mean '{meant}'?"
    warned = [text for text in decision.warnings if "did you mean" in text]
    assert [told in text for text in warned] == [True] * bool(meant)
