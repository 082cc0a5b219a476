"""HTTP calls to other services: the only module that imports httpx.

A call trusts the certificates in ``SSL_CERT_FILE``, or the system's if the variable is not set. It
uses the proxy that the usual environment variables name. It follows no redirect, because
credentials must not reach another host. The answer's length and duration are limited. No error
contains the URL or a header, because they may hold secrets.
"""

from __future__ import annotations

import logging
import ssl
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from demandops import __version__
from demandops.errors import DemandOpsError
from demandops.quoting import one_line
from demandops.runtime import REAL

if TYPE_CHECKING:
    import httpx

_MOST_BYTES = 4_000_000
_TOO_MANY_REQUESTS = 429

for _name in ("httpx", "httpcore"):  # they log URLs and headers
    logging.getLogger(_name).setLevel(logging.WARNING)


class NoAnswer(DemandOpsError):
    """Raised when a service gives no usable answer; the message says why and what to check."""


@dataclass(frozen=True, slots=True)
class HttpAnswer:
    """An answer: its status, the status in words, and the body.

    ``asks_to_wait`` says whether the service got too many calls. Some services then answer with
    status 429, others (GitHub) with 403 and headers that say so.
    """

    status: int
    reason: str
    body: bytes
    asks_to_wait: bool = False

    @property
    def is_success(self) -> bool:
        """Whether the service accepted the call."""
        return 200 <= self.status < 300

    @property
    def is_redirect(self) -> bool:
        """Whether the service redirects the caller."""
        return 300 <= self.status < 400


def call(
    method: str, url: str, headers: Mapping[str, str], body: bytes | None, timeout: float
) -> HttpAnswer:
    """Send a request and return the answer, whatever its status.

    Args:
        method, url, headers, body: the request.
        timeout: how many seconds it may take to connect, to send, and to receive each part of the
            answer. The answer must be complete within twice this time.

    Raises:
        NoAnswer: if there is no answer, or if the answer is too long or too slow.
    """
    import httpx  # noqa: PLC0415 - slow (a tenth of a second), so only on use

    headers = {"User-Agent": f"demandops/{__version__}", "Accept-Encoding": "identity", **headers}
    end = REAL.monotonic() + 2 * timeout
    try:
        with (
            httpx.Client(verify=_trust(url), timeout=timeout) as client,
            client.stream(method, url, headers=headers, content=body) as answer,
        ):
            content = b""
            for chunk in answer.iter_raw():
                content += chunk
                if len(content) > _MOST_BYTES:
                    raise NoAnswer(f"the answer is longer than {_MOST_BYTES} bytes; check the URL")
                if REAL.monotonic() > end:
                    raise NoAnswer(_too_slow(timeout))
            return HttpAnswer(
                answer.status_code,
                answer.reason_phrase,
                content,
                answer.status_code == _TOO_MANY_REQUESTS
                or (answer.is_error and "retry-after" in answer.headers)
                or (answer.is_error and answer.headers.get("x-ratelimit-remaining") == "0"),
            )
    except httpx.TimeoutException:
        raise NoAnswer(_too_slow(timeout)) from None
    except httpx.TransportError as error:
        raise NoAnswer(_cause(error)) from None
    except (httpx.InvalidURL, ValueError):
        raise NoAnswer("the URL or a header is not valid; check them") from None


def _trust(url: str) -> ssl.SSLContext:
    """Return the certificates that a call trusts; none for plain HTTP, because loading is slow."""
    if url.startswith("http://"):
        return ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    return ssl.create_default_context()


def _too_slow(timeout: float) -> str:
    return f"no complete answer within {timeout:g} s; check that the server runs and can be reached"


def _cause(error: httpx.TransportError) -> str:
    """Return the reason why there is no answer; it contains no part of the request."""
    if type(error).__name__ in ("LocalProtocolError", "UnsupportedProtocol"):
        return "the URL or a header is not valid; check them"
    text = one_line(str(error) or type(error).__name__)
    if "CERTIFICATE_VERIFY_FAILED" in text:
        return f"{text}; if you trust the certificate, set SSL_CERT_FILE to its file"
    return f"{text}; check that the server runs and can be reached"
