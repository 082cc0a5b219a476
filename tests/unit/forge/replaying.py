"""A forge on the loopback that replays recorded exchanges, and fails what was not recorded.

An exchange is a request as the forge's API documents it, and the answer: in
``exchanges/<name>.yaml``, in order. The token's value is looked at and not recorded.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import yaml

TOKEN = "t0ken-of-nobody"  # noqa: S105 - it opens nothing
_EXCHANGES = Path(__file__).with_name("exchanges")
_IGNORED = {"host", "connection", "accept-encoding", "user-agent", "content-length"}


@dataclass
class Replay:
    """A running replay: where it is, what is still to come, what went wrong."""

    url: str = ""
    left: list[dict[str, Any]] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    came: list[dict[str, Any]] = field(default_factory=list)


@contextmanager
def replaying(*names: str, variables: dict[str, str] | None = None) -> Iterator[Replay]:
    """Replay recorded exchanges one after the other; ``variables`` fill ``{name}`` in them."""
    replay = Replay()
    for name in names:
        text = (_EXCHANGES / f"{name}.yaml").read_text()
        for key, value in (variables or {}).items():
            text = text.replace("{" + key + "}", value)
        replay.left += yaml.safe_load(text)
    handler = type("Handler", (_Handler,), {"replay": replay})
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    replay.url = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True)
    thread.start()
    try:
        yield replay
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


class _Handler(BaseHTTPRequestHandler):
    replay: Replay

    def _serve(self) -> None:
        length = int(self.headers.get("Content-Length") or 0)
        body = json.loads(self.rfile.read(length)) if length else None
        headers = {k.lower(): v for k, v in self.headers.items() if k.lower() not in _IGNORED}
        if not headers.get("authorization", "").endswith(f" {TOKEN}"):
            self.replay.problems.append("the token is not there")
        headers["authorization"] = headers.get("authorization", "").split(" ")[0] + " TOKEN"
        request = {"method": self.command, "path": self.path, "headers": headers, "body": body}
        self.replay.came.append(request)
        recorded = self.replay.left.pop(0) if self.replay.left else None
        if recorded is None or recorded["request"] != request:
            self.replay.problems.append(f"came {request}, recorded {recorded}")
            self.send_error(599)
            return
        answer = recorded["response"]
        data = json.dumps(answer["body"]).encode()
        self.send_response(answer["status"])
        for name, value in answer.get("headers", {}).items():
            self.send_header(name, value)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    do_GET = do_POST = do_PATCH = _serve

    def log_message(self, format: str, *args: object) -> None:
        """Keep quiet."""
