"""Calls to a forge's API: JSON over HTTP with a token. No message contains the token."""

from __future__ import annotations

import json
import urllib.error
import urllib.request
from collections.abc import Mapping
from http.client import HTTPException, HTTPResponse
from typing import IO, Any

from demandops import __version__
from demandops.errors import DemandOpsError, quoted

_TIMEOUT_S = 15.0
_MOST_BYTES = 4_000_000


class ForgeError(DemandOpsError):
    """Raised when a forge fails or refuses; ``status`` is its HTTP status, if it answered."""

    def __init__(self, message: str, status: int | None = None) -> None:
        super().__init__(message)
        self.status = status


class _NoRedirects(urllib.request.HTTPRedirectHandler):
    """Follows no redirect: the token must not reach another host."""

    def redirect_request(
        self,
        req: urllib.request.Request,
        fp: IO[bytes],
        code: int,
        msg: str,
        headers: Any,  # noqa: ANN401 - as the library declares it
        newurl: str,
    ) -> urllib.request.Request | None:
        return None


class Api:
    """The API of a forge at one address."""

    def __init__(self, address: str, token: str, timeout: float = _TIMEOUT_S) -> None:
        self._address = address.rstrip("/")
        self._token = token
        self._timeout = timeout
        self._opener = urllib.request.build_opener(_NoRedirects())

    def call(
        self,
        method: str,
        path: str,
        headers: Mapping[str, str],
        body: Mapping[str, object] | None = None,
    ) -> Any:  # noqa: ANN401 - the caller knows the answer's form
        """Send a request and return the answer's JSON.

        Args:
            method: the HTTP method.
            path: the path below the API's address.
            headers: the HTTP headers; ``{token}`` in a value is replaced by the token.
            body: the JSON to send.

        Raises:
            ForgeError: if the forge does not answer, refuses, or answers without JSON.
        """
        where = f"{method} {self._address}{path}"
        request = urllib.request.Request(  # noqa: S310 - https, or http on this machine
            f"{self._address}{path}",
            data=json.dumps(body).encode() if body is not None else None,
            method=method,
            headers={
                "User-Agent": f"demandops/{__version__}",
                **{key: value.format(token=self._token) for key, value in headers.items()},
                **({"Content-Type": "application/json"} if body is not None else {}),
            },
        )
        try:
            with self._opener.open(request, timeout=self._timeout) as answer:
                return _json(answer, where)
        except urllib.error.HTTPError as error:
            with error:
                reason = _reason(error)
            raise ForgeError(f"{where}: {error.code} {reason}", error.code) from None
        except (OSError, HTTPException) as error:
            cause = getattr(error, "reason", None) or error
            raise ForgeError(f"{where}: {cause}") from None


def _json(answer: HTTPResponse, where: str) -> Any:  # noqa: ANN401
    data = answer.read(_MOST_BYTES)
    try:
        return json.loads(data) if data.strip() else None
    except ValueError:
        raise ForgeError(f"{where}: the answer is not JSON; check the API's address") from None


def _reason(error: urllib.error.HTTPError) -> str:
    """Return a forge's reason for a refusal: its ``message``, and those of ``errors``."""
    try:
        data = json.loads(error.read(_MOST_BYTES))
    except (ValueError, OSError):
        data = None
    answer = data if isinstance(data, dict) else {"message": str(error.reason)}
    details = answer.get("errors")
    texts = [answer.get("message"), *(details if isinstance(details, list) else ())]
    texts = [text.get("message") if isinstance(text, dict) else text for text in texts]
    return quoted("; ".join(text for text in texts if isinstance(text, str) and text), 300)
