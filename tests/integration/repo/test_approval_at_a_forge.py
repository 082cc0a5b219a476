"""The generator opens a pull request for each proposal; a person decides by merging or closing it.

The forge is a small server on the loopback that handles pull requests as GitHub's API does.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlparse

import pytest
from demandops.serve import proposal

from tests.kit import goals, rig
from tests.kit.http import Answer, Call, serving
from tests.kit.repo import Person, branches, git
from tests.kit.rig import Proposed, goal

TOKEN = "t0ken-of-nobody"  # noqa: S105 - no real token


@dataclass
class Hub:
    url: str = ""
    pulls: list[dict[str, Any]] = field(default_factory=list)
    away: bool = False

    def answer(self, call: Call) -> Answer:
        assert call.headers["Authorization"] == f"Bearer {TOKEN}"
        status, found = self._found(call.method, call.path, call.json())
        return Answer.json(found, status)

    def _found(self, method: str, path: str, body: dict[str, Any] | None) -> tuple[int, Any]:
        url = urlparse(path)
        if self.away:
            return 503, {"message": "Service unavailable"}
        if method == "POST" and url.path == "/repos/its/state/pulls":
            assert body is not None
            number = len(self.pulls) + 1
            link = f"https://github.com/its/state/pull/{number}"
            made = {"number": number, "state": "open", "merged_at": None, "html_url": link} | body
            self.pulls.append(made)
            return 201, made
        if method == "PATCH":
            assert body is not None
            self.pulls[int(url.path.rsplit("/", 1)[1]) - 1].update(body)
            return 200, self.pulls[-1]
        if url.path.startswith("/repos/its/state/commits/"):
            commit = url.path.split("/")[-2]
            return 200, [pull for pull in self.pulls if pull.get("merge_commit_sha") == commit]
        if method == "POST" and url.path.endswith("/comments"):
            assert body is not None
            number = int(url.path.split("/")[-2])
            self.pulls[number - 1].setdefault("comments", []).append(body["body"])
            return 201, {}
        branch = parse_qs(url.query)["head"][0].removeprefix("its:")
        return 200, [pull for pull in self.pulls if pull["head"] == branch][-1:]


@pytest.fixture
def hub() -> Iterator[Hub]:
    made = Hub()
    with serving(made.answer) as server:
        made.url = server.url
        yield made


@pytest.fixture
def petra(hub: Hub, petra: Person, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Person:
    monkeypatch.setattr(proposal, "POLL_S", 0.05)
    (tmp_path / "token").write_text(TOKEN)
    monkeypatch.setenv("DEMANDOPS_FORGE_TOKEN_FILE", str(tmp_path / "token"))
    root = petra.read("demandops.yaml")
    where = f"forge: github, url: 'https://github.com/its/state', api: '{hub.url}'"
    petra.change({"demandops.yaml": f"{root}\nproposals: {{{where}}}\n"})
    return petra


def visit(vehicle: str) -> Any:
    return goals.put("visit", "user", topic=(f"/vehicles/{vehicle}/ego_data", vehicle))


def test_a_pull_request_is_opened_and_closed_for_the_one_that_replaces_it(
    hub: Hub, url: str, bare: Path, petra: Person
) -> None:
    with rig.running(url) as generator:
        first = Proposed(generator, visit("vehicle01"))
        seen = f"{first.branch} {git(bare, 'rev-parse', first.branch)}"
        [pull] = hub.pulls
        assert f"{first.branch} {pull['html_url']} (required by" in first.told[-1][1]
        assert (pull["head"], pull["base"]) == (first.branch, "main")
        assert pull["title"] == "Put edge/visit, derived/vehicle01/edge/vehicles/vehicle01/ego_data"
        assert "This demand needs approval, as required by ` access domain" in pull["body"]
        second = Proposed(generator, visit("vehicle02"))
        assert f"{second.branch} https://github.com/its/state/pull/2 " in second.told[-1][1]
        rig.wait_until(lambda: pull["state"] == "closed", "the old one is closed")
        assert second.branch in pull["body"].splitlines()[0]
        assert pull["body"].endswith("```\n"), "the text is kept"
        changed = f"This has changed: it replaces {seen}, and no approval of that counts here. "
        assert hub.pulls[1]["body"].startswith(changed)
        petra.merge(second.branch)
        assert second.outcome() == "booked"
    assert hub.pulls[1]["state"] == "open", "the generator must not merge"


@pytest.mark.parametrize("when", ["while it runs", "before a restart", "withdrawn"])
def test_a_closed_pull_request_turns_the_demand_down_and_is_not_opened_again(
    hub: Hub, bare: Path, petra: Person, when: str
) -> None:
    with rig.running(bare) as generator:
        proposed = Proposed(generator, goal(1), "op-1")
        assert [proposed.branch] == branches(bare)
        if when == "withdrawn":
            assert generator.withdraw("op-1")
            assert proposed.outcome() == "Withdrawn"
            rig.wait_until(lambda: hub.pulls[0]["state"] == "closed", "it is closed")
        if when == "while it runs":
            hub.pulls[0]["state"] = "closed"
            assert proposed.outcome() == "TurnedDown"
            assert "/pull/1 was closed" in str(proposed.ticket.future.exception())
    with rig.running(bare) as generator:
        assert len(hub.pulls) == 1, "a restart must open no second one"
        hub.pulls[0]["state"] = "closed"
        rig.wait_until(lambda: branches(bare) == [], "the demand is turned down")
    assert len(hub.pulls) == 1


def test_a_forge_that_is_away_holds_nothing_up_and_is_asked_again(
    hub: Hub, bare: Path, petra: Person, caplog: pytest.LogCaptureFixture
) -> None:
    hub.away = True
    with caplog.at_level(logging.INFO), rig.running(bare) as generator:
        proposed = Proposed(generator, goal(1))
        branch = proposed.branch
        assert "https://" not in proposed.told[-1][1]
        hub.away = False
        rig.wait_until(lambda: "/pull/1 " in proposed.told[-1][1], "the requester has the link")
        petra.merge(branch)
        assert proposed.outcome() == "booked"
    assert f"{branch}: GET http://127.0.0.1" in caplog.text
    assert "503 'Service unavailable'" in caplog.text
    assert TOKEN not in caplog.text


def test_the_pull_request_whose_merge_is_not_in_effect_is_told(
    hub: Hub, url: str, bare: Path, petra: Person
) -> None:
    with rig.running(url) as generator:
        proposed = Proposed(generator, goals.put("visit", "user"))
        petra.merge(proposed.branch)
        assert proposed.outcome() == "booked"
        gone = {"kind": "Demand", "demand": "visit", "requesters": ["user"], "operation": "release"}
        rig.book(generator, gone)
    made = petra.change({"overrides/odd.yaml": "`a`: @b\n"})
    pull = {"number": 1, "state": "closed", "merged_at": "2026-01-01", "merge_commit_sha": made}
    hub.pulls.append(
        pull | {"number": 2, "head": "odd", "html_url": "https://github.com/its/state/pull/2"}
    )
    with rig.running(url) as generator:
        generator.fetch_now()
        rig.wait_until(lambda: "comments" in hub.pulls[1], "the pull request has a comment")
    (told,) = hub.pulls[1]["comments"]
    assert told.startswith("This is not in effect, because main is not valid; ")
    assert "overrides/odd.yaml" in told and f"git revert --no-edit -m 1 {made[:10]}" in told
