"""The requests of the forge adapters match recordings: method, path, headers and body.

An exchange is a request as the forge's API documents it, and its answer. ``exchanges/<name>.yaml``
lists the exchanges in order. A forge on the loopback replays them, and refuses all other requests.
It also checks the token, which is not in the recording.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from demandops.model.config.repo_settings import Proposals
from demandops.repo.forge import Forge, ForgeError, PullRequest, forge_for
from demandops.serve.proposal import ForgeWorker

from tests.kit import plain_yaml
from tests.kit.clock import Turns
from tests.kit.http import Answer, Call, serving

TOKEN = "t0ken-of-nobody"  # noqa: S105 - no real token
_EXCHANGES = Path(__file__).with_name("exchanges")
_IGNORED = {"host", "connection", "accept-encoding", "user-agent", "content-length"}


@dataclass
class Replay:
    """A running replay: the exchanges still to come, and the problems."""

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


TABLES = plain_yaml.beside(__file__, "forges")
BRANCH = "demand/one-0123456789ab"
LINKS = {
    "github": "https://github.com/its/state/pull/7",
    "gitea": "https://git.example.org/its/state/pulls/7",
}


@pytest.fixture
def token(tmp_path: Path) -> Path:
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
    """Replay exchanges in order; each ``{x}`` in them is replaced by the value of ``x``."""
    text = (_EXCHANGES / f"{kind}-{name}.yaml").read_text()
    for key, value in variables.items():
        text = text.replace("{" + key + "}", value)
    replay = Replay(left=plain_yaml.load(text))
    with serving(replay.answer) as server:
        yield forge_at(kind, server.url, token)
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


@pytest.mark.parametrize(
    ("status", "headers"),
    [(429, {}), (403, {"Retry-After": "60"}), (403, {"X-RateLimit-Remaining": "0"})],
)
def test_a_forge_that_is_asked_too_often_is_left_alone_for_a_minute(
    token: Path, status: int, headers: dict[str, str]
) -> None:
    turns, told = Turns(1), list[str]()
    with serving(lambda call: Answer.json({"message": "slow"}, status, **headers)) as server:
        worker = ForgeWorker(token, told.append, turns)
        for branch in ("demand/x", "demand/y"):
            worker.open(proposals(api=server.url), branch, "x", "x")
        turns.sleep(59)
        assert len(server.calls) == 1
        assert told == ["demand/x", "demand/y"], "their requesters need not wait"
        turns.sleep(2)
        assert len(server.calls) == 2


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
