"""A forge on the loopback that replays recorded exchanges, and refuses all other requests.

An exchange is a request as the forge's API documents it, and its answer. ``exchanges/<name>.yaml``
lists the exchanges in order. The replay also checks the token, which is not in the recording.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.kit import plain_yaml
from tests.kit.http import Answer, Call, serving

TOKEN = "t0ken-of-nobody"  # noqa: S105 - no real token
_EXCHANGES = Path(__file__).with_name("exchanges")
_IGNORED = {"host", "connection", "accept-encoding", "user-agent", "content-length"}


@dataclass
class Replay:
    """A running replay: its URL, the exchanges still to come, the problems, and past requests."""

    url: str = ""
    left: list[dict[str, Any]] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    came: list[dict[str, Any]] = field(default_factory=list)

    def answer(self, call: Call) -> Answer:
        headers = {k.lower(): v for k, v in call.headers.items() if k.lower() not in _IGNORED}
        if not headers.get("authorization", "").endswith(f" {TOKEN}"):
            self.problems.append("the token is not there")
        headers["authorization"] = headers.get("authorization", "").split(" ")[0] + " TOKEN"
        request = {
            "method": call.method,
            "path": call.path,
            "headers": headers,
            "body": call.json(),
        }
        self.came.append(request)
        recorded = self.left.pop(0) if self.left else None
        if recorded is None or recorded["request"] != request:
            self.problems.append(f"came {request}, recorded {recorded}")
            return Answer(599)
        answer = recorded["response"]
        return Answer.json(answer["body"], answer["status"], **answer.get("headers", {}))


@contextmanager
def replaying(*names: str, variables: dict[str, str] | None = None) -> Iterator[Replay]:
    """Replay recorded exchanges in order.

    In the recordings, each ``{x}`` is replaced by the value of the variable ``x``.
    """
    replay = Replay()
    for name in names:
        text = (_EXCHANGES / f"{name}.yaml").read_text()
        for key, value in (variables or {}).items():
            text = text.replace("{" + key + "}", value)
        replay.left += plain_yaml.load(text)
    with serving(replay.answer) as server:
        replay.url = server.url
        yield replay
