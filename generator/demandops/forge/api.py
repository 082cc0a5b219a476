"""Calls to a forge's API: JSON over HTTP with a token, which no message ever shows."""

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
    """The forge did not do what it was asked; ``status`` is its HTTP status, if it answered."""

    def __init__(self, message: str, status: int | None = None) -> None:
        super().__init__(message)
        self.status = status


class _NoRedirects(urllib.request.HTTPRedirectHandler):
    """Follow none: the token must not reach another host."""

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
    """An API at one address."""

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
        """Send a request and return the answer's JSON; ``headers`` may hold ``{token}``.

        Raises:
            ForgeError: where the forge is away, refuses, or answers with something else.
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
                said = _said(error)
            raise ForgeError(f"{where}: {error.code} {said}", error.code) from None
        except (OSError, HTTPException) as error:
            reason = getattr(error, "reason", None) or error
            raise ForgeError(f"{where}: {reason}") from None


def _json(answer: HTTPResponse, where: str) -> Any:  # noqa: ANN401
    data = answer.read(_MOST_BYTES)
    try:
        return json.loads(data) if data.strip() else None
    except ValueError:
        raise ForgeError(f"{where}: the answer is no JSON; is this the API's address?") from None


def _said(error: urllib.error.HTTPError) -> str:
    """Return what a forge says of a refusal: its ``message``, and those of ``errors``."""
    try:
        data = json.loads(error.read(_MOST_BYTES))
    except (ValueError, OSError):
        data = None
    said = data if isinstance(data, dict) else {"message": str(error.reason)}
    more = said.get("errors")
    texts = [said.get("message"), *(more if isinstance(more, list) else ())]
    texts = [text.get("message") if isinstance(text, dict) else text for text in texts]
    return quoted("; ".join(text for text in texts if isinstance(text, str) and text), 300)
