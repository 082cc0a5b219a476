"""The requests of the forge adapters match recordings: method, path, headers and body.

An exchange is a request as the forge's API documents it, and its answer. ``exchanges/<name>.yaml``
lists the exchanges in order. A forge on the loopback replays them, and refuses all other requests.
It also checks the token, which is not in the recording.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from demandops.base.errors import InvalidInput
from demandops.model.config.load import load
from demandops.model.config.repo_settings import Proposals
from demandops.repo.forge import Forge, ForgeError, Gitea, PullRequest, forge_for
from demandops.serve.proposal import ForgeWorker

from tests.kit import plain_yaml
from tests.kit.clock import Turns
from tests.kit.config import configuration
from tests.kit.http import Answer, Call, Server, serving

TOKEN = "t0ken-of-nobody"  # noqa: S105 - no real token
_EXCHANGES = Path(__file__).with_name("exchanges")
_IGNORED = {"host", "connection", "accept-encoding", "user-agent", "content-length"}


@dataclass
class Replay:
    """A running replay: its URL, the exchanges still to come, and the problems."""

    url: str = ""
    left: list[dict[str, Any]] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    def answer(self, call: Call) -> Answer:
        headers = {k.lower(): v for k, v in call.headers.items() if k.lower() not in _IGNORED}
        scheme, _, given = headers.get("authorization", "").partition(" ")
        if given != TOKEN:
            self.problems.append("the token is not there")
        headers["authorization"] = f"{scheme} TOKEN"
        request = {"method": call.method, "path": call.path, "headers": headers}
        request["body"] = call.json()
        recorded = self.left.pop(0) if self.left else None
        if recorded is None or recorded["request"] != request:
            self.problems.append(f"came {request}, recorded {recorded}")
            return Answer(599)
        answer = recorded["response"]
        return Answer.json(answer["body"], answer["status"], **answer.get("headers", {}))


@contextmanager
def replaying(name: str, variables: dict[str, str]) -> Iterator[Replay]:
    """Replay exchanges in order; each ``{x}`` in them is replaced by the value of ``x``."""
    text = (_EXCHANGES / f"{name}.yaml").read_text()
    for key, value in variables.items():
        text = text.replace("{" + key + "}", value)
    replay = Replay(left=plain_yaml.load(text))
    with serving(replay.answer) as server:
        replay.url = server.url
        yield replay


TABLES = plain_yaml.load(Path(__file__).with_name("forges.yaml").read_text())
BRANCH = "demand/one-0123456789ab"
LINKS = {
    "github": "https://github.com/its/state/pull/7",
    "gitea": "https://git.example.org/its/state/pulls/7",
}


@pytest.fixture
def token(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    file = tmp_path / "token"
    file.write_text(f"{TOKEN}\n")
    return file


@pytest.fixture(params=["github", "gitea"])
def kind(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def proposals(kind: str = "github", url: str = "https://github.com/a/b", **more: str) -> Proposals:
    return Proposals.model_validate({"forge": kind, "url": url, **more})


def forge_at(kind: str, api: str, token: Path) -> Forge:
    made = forge_for(proposals(kind, "https://git.example.org/its/state", api=api), token)
    assert made is not None
    return made


@contextmanager
def forge(kind: str, name: str, token: Path, **variables: str) -> Iterator[Forge]:
    with replaying(f"{kind}-{name}", variables=variables) as replay:
        yield forge_at(kind, replay.url, token)
        assert (replay.problems, replay.left) == ([], [])


def open_one(made: Forge) -> PullRequest:
    return made.open(BRANCH, "main", "Join one", "A *body*\n")


@pytest.mark.parametrize(
    ("name", "state"), [("new", "open"), ("there", "open"), ("lost", "open"), ("closed", "closed")]
)
def test_a_request_is_opened_once_whatever_happened_before(
    kind: str, name: str, state: str, token: Path
) -> None:
    with forge(kind, name, token) as made:
        found = open_one(made)
    assert found == PullRequest(7, LINKS[kind], state)


@pytest.mark.parametrize("state", ["merged", "closed", "none"])
def test_what_became_of_a_request_is_told(kind: str, state: str, token: Path) -> None:
    with forge(kind, state, token) as made:
        found = made.find(BRANCH, "main")
    assert (found.state if found else "none") == state


def test_a_request_is_closed(kind: str, token: Path) -> None:
    with forge(kind, "close", token) as made:
        made.close(PullRequest(7, LINKS[kind], "open"), "Closed: ` was replaced `")


def test_what_a_commit_came_by_gets_a_comment(kind: str, token: Path) -> None:
    with forge(kind, "comment", token) as made:
        made.comment("c" * 40, "It is not in effect.")
        made.comment("d" * 40, "It is not in effect.")


def test_a_refusal_is_told_in_the_forges_words_without_the_token(kind: str, token: Path) -> None:
    with forge(kind, "denied", token) as made, pytest.raises(ForgeError) as error:
        open_one(made)
    assert error.value.status == 401
    assert str(error.value).endswith(": 401 'Bad credentials'")

    def echo(call: Call) -> Answer:
        return Answer.json({"message": f"bad header: {call.headers['Authorization']}"}, 400)

    with serving(echo) as there, pytest.raises(ForgeError, match="400 'bad header: ") as error:
        forge_at(kind, there.url, token).find(BRANCH, "main")
    assert TOKEN not in str(error.value)


def test_the_token_follows_no_redirect(kind: str, token: Path) -> None:
    with (
        serving() as there,
        forge(kind, "moved", token, elsewhere=there.url) as made,
        pytest.raises(ForgeError),
    ):
        made.find(BRANCH, "main")
    assert there.calls == []


def test_a_forge_that_is_away_is_told(kind: str, token: Path) -> None:
    with serving() as gone:
        pass
    with pytest.raises(ForgeError, match="refused") as error:
        forge_at(kind, gone.url, token).find(BRANCH, "main")
    assert error.value.status is None


ODD = " must hold a token: one line of plain text"


@pytest.mark.parametrize(
    ("content", "message"),
    [(None, ": cannot be read: No such"), (b"two\nlines", ODD), (b"\xff\xfe", ODD)],
)
def test_a_token_file_that_is_none_is_told(
    tmp_path: Path, content: bytes | None, message: str
) -> None:
    file = tmp_path / "token"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(ForgeError, match=f"the token file {file}{message}"):
        forge_for(proposals(), file)
    with pytest.raises(ForgeError, match="DEMANDOPS_FORGE_TOKEN_FILE"):
        forge_for(proposals(), None)


@contextmanager
def asked(
    token: Path, answer: Answer, *branches: str
) -> Iterator[tuple[Turns, Server, list[tuple[str, int]]]]:
    """Let a worker open pull requests at a forge that always gives the same answer.

    The list has each branch of which the worker told, and the number of calls until then.
    """
    turns, told = Turns(1), list[tuple[str, int]]()
    with serving(lambda call: answer) as server:
        worker = ForgeWorker(token, lambda branch: told.append((branch, len(server.calls))), turns)
        for branch in branches:
            worker.open(proposals(api=server.url), branch, "x", "x")
        yield turns, server, told


@pytest.mark.parametrize(
    ("status", "headers"),
    [(429, {}), (403, {"Retry-After": "60"}), (403, {"X-RateLimit-Remaining": "0"})],
)
def test_a_forge_that_is_asked_too_often_is_left_alone_for_a_minute(
    token: Path, status: int, headers: dict[str, str]
) -> None:
    slow_down = Answer.json({"message": "slow down"}, status, **headers)
    with asked(token, slow_down, "demand/x", "demand/y", "demand/z") as (turns, server, told):
        turns.sleep(59)
        assert len(server.calls) == 1
        assert [branch for branch, _ in told] == ["demand/x", "demand/y", "demand/z"], (
            "their requesters need not wait"
        )
        turns.sleep(2)
        assert len(server.calls) == 2


def test_a_forge_that_may_not_be_used_is_asked_again_at_the_usual_interval(token: Path) -> None:
    denied = Answer.json({"message": "no"}, 403)
    with asked(token, denied, "demand/x") as (turns, server, _):
        turns.sleep(31)
        assert len(server.calls) == 2


def test_while_a_forge_is_away_no_requester_waits_for_the_calls_of_others(token: Path) -> None:
    odd = Answer(200, b"<html>")
    with asked(token, odd, "demand/x", "demand/y") as (turns, _, told):
        turns.sleep(1)
        assert told == [("demand/x", 1), ("demand/y", 1)]


@pytest.mark.parametrize(("kind", "url", "address"), TABLES["addresses"])
def test_the_apis_address_follows_from_the_projects(
    kind: str, url: str, address: str, token: Path
) -> None:
    made = forge_for(proposals(kind, url), token)
    assert made is not None
    assert (made._api, made._pulls) == (address, "/repos/its/state/pulls")


def test_forges_without_an_api_are_asked_nothing() -> None:
    for name in ("none", "gitlab"):
        assert forge_for(Proposals.model_validate({"forge": name}), None) is None


@pytest.mark.parametrize(("section", "message"), TABLES["sections"])
def test_a_section_that_cannot_work_is_refused(section: str, message: str) -> None:
    config = configuration()
    config["demandops.yaml"] += f"\nproposals: {section}\n"
    with pytest.raises(InvalidInput) as error:
        load(config)
    faults = [str(found) for found in error.value.faults]
    assert any(message in found for found in faults), faults


@pytest.mark.parametrize(
    ("number", "link"), [("1e999", "https://x"), ("null", "https://x"), ("1", r"https://x\nA: b")]
)
def test_an_answer_with_an_odd_number_or_link_is_no_pull_request(number: str, link: str) -> None:
    answer = f'{{"number": {number}, "html_url": "{link}", "merged": false, "state": "open"}}'
    message = "https://x: the answer is not a pull request; check that this is the address of Gitea"
    with pytest.raises(ForgeError, match=message):
        Gitea("https://x", "token", "owner", "name")._read(json.loads(answer))
