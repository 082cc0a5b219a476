"""The inbound webhook: a Git server reports a push, and the generator fetches at once.

Notifications are untrusted: only the signature is checked, and the content is not read.
"""

from __future__ import annotations

import hashlib
import hmac
import logging
from collections.abc import Callable
from pathlib import Path

from starlette.requests import ClientDisconnect, Request
from starlette.responses import PlainTextResponse
from starlette.routing import Route

from demandops.errors import InvalidInput, fault
from demandops.runtime import REAL

log = logging.getLogger("demandops")

PATH = "/push"
_MAX_BODY = 25 << 20
"""The most that GitHub sends; the body is hashed, not stored."""
_WARN_EVERY_S = 60.0

_SIGNATURES = ("X-Hub-Signature-256", "X-Gitea-Signature", "X-Forgejo-Signature")
_TOKEN = "X-Gitlab-Token"  # noqa: S105 - a header's name


def read_secret(path: Path) -> bytes:
    """Return the secret in a file, without surrounding white space.

    Raises:
        InvalidInput: if the file cannot be read or is empty.
    """
    try:
        secret = path.read_bytes().strip()
    except OSError as error:
        message = f"cannot be read: {error.strerror or error}; put the webhook's secret there"
        raise InvalidInput([fault("", message).within(str(path))]) from None
    if not secret:
        message = "is empty; put there the secret that the Git server signs with"
        raise InvalidInput([fault("", message).within(str(path))])
    return secret


class PushWebhook:
    """Handles notifications.

    Args:
        secret: the key that signs notifications; empty: unsigned ones are accepted.
        on_push: called for each notification; must return at once.
    """

    def __init__(self, secret: bytes, on_push: Callable[[], None]) -> None:
        self._secret, self._on_push = secret, on_push
        self._warned = float("-inf")
        self.route = Route(PATH, self._handle, methods=["POST"])

    async def _handle(self, request: Request) -> PlainTextResponse:
        """Check a notification and report the push."""
        digest, length = hmac.new(self._secret, digestmod=hashlib.sha256), 0
        too_long = PlainTextResponse("the body is too long\n", 413)
        if int(request.headers.get("Content-Length", "0")) > _MAX_BODY:
            return too_long
        try:
            async for chunk in request.stream():
                length += len(chunk)
                if length > _MAX_BODY:
                    return too_long
                digest.update(chunk)
        except ClientDisconnect:
            return PlainTextResponse("the body is not complete\n", 400)
        if self._secret and not self._is_signed(request, digest.hexdigest()):
            self._warn(request.client.host if request.client else "")
            return PlainTextResponse("not signed with the secret\n", 403)
        self._on_push()
        return PlainTextResponse("fetching\n", 202)

    def _is_signed(self, request: Request, digest: str) -> bool:
        signatures = [request.headers.get(name, "").removeprefix("sha256=") for name in _SIGNATURES]
        signed = [hmac.compare_digest(_bytes(s), digest.encode()) for s in signatures]
        token = hmac.compare_digest(_bytes(request.headers.get(_TOKEN, "")), self._secret)
        return any(signed) or token

    def _warn(self, sender: str) -> None:
        """Log a warning at most once a minute, because anyone may send requests."""
        if REAL.monotonic() - self._warned > _WARN_EVERY_S:
            self._warned = REAL.monotonic()
            log.warning(
                "a notification from %s was not signed with the webhook's secret; is it the same "
                "here and at the Git server?",
                sender,
            )


def _bytes(text: str) -> bytes:
    return text.encode("latin-1").strip()
