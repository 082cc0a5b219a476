"""HTTP calls to other services: the only module that imports httpx.

A call trusts the certificates that OpenSSL trusts by default: those of the system. The variable
``SSL_CERT_FILE`` replaces the system's file, and ``SSL_CERT_DIR`` the system's folder. A call uses
the HTTP proxy that the usual environment variables name. It follows no redirect, because
credentials must not reach another host. The answer's length and duration are limited. An error
contains nothing of the request but the host's name, because a URL or a header may hold secrets.
"""

from __future__ import annotations

import logging
import re
import ssl
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain

from demandops import __version__
from demandops.base.errors import DemandOpsError
from demandops.base.quoting import one_line
from demandops.base.runtime import REAL

_MOST_BYTES = 4_000_000
_INVALID = "the URL, a header or the proxy's address is not valid; check them"
# The reason for each type of httpx error whose own text may echo the request
_CAUSES = {
    "LocalProtocolError": _INVALID,
    "UnsupportedProtocol": _INVALID,
    "RemoteProtocolError": "the answer is not HTTP, or not complete; check the URL and the server",
    "ProxyError": "the proxy refuses the connection; check HTTPS_PROXY and ALL_PROXY",
}

# What to do about an error whose text has the words
_REMEDIES = (
    ("CERTIFICATE_VERIFY_FAILED.*mismatch", "use a host that the certificate names"),
    ("CERTIFICATE_VERIFY_FAILED.*expired", "renew the certificate"),
    ("CERTIFICATE_VERIFY_FAILED", "if you trust the certificate, set SSL_CERT_FILE to its file"),
)

for _name in ("httpx", "httpcore"):  # they log URLs and headers
    logging.getLogger(_name).setLevel(logging.WARNING)


class NoAnswer(DemandOpsError):
    """Raised when a service gives no usable answer; the message says why and what to check."""


@dataclass(frozen=True, slots=True)
class HttpAnswer:
    status: int
    reason: str  # the status in words
    body: bytes
    asks_to_wait: bool = False  # mostly because the service got too many calls

    @property
    def is_success(self) -> bool:
        return 200 <= self.status < 300


def call(
    method: str, url: str, headers: Mapping[str, str], body: bytes | None, timeout: float
) -> HttpAnswer:
    """Send a request and return the answer, whatever its status.

    It may take ``timeout`` seconds to connect, to send, and to receive each part of the answer, and
    twice this time in all.
    """
    import httpx  # noqa: PLC0415 - slow (a tenth of a second), so only on use

    # identity, because iter_raw decodes nothing: a short compressed answer may decode to a long one
    headers = {"User-Agent": f"demandops/{__version__}", "Accept-Encoding": "identity", **headers}
    if url.startswith("http://"):  # needs no certificates, which are slow to load
        trust = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    else:
        trust = ssl.create_default_context()
    end = REAL.monotonic() + 2 * timeout
    too_slow = (
        f"no complete answer within {timeout:g} s; check that the server runs and can be reached"
    )
    try:
        with (  # httpx follows no redirect by itself, and so takes no token to another host
            httpx.Client(verify=trust, timeout=timeout) as client,
            client.stream(method, url, headers=headers, content=body) as answer,
        ):
            content = b""
            for chunk in chain(answer.iter_raw(), [b""]):  # its end may come late, too
                content += chunk
                if len(content) > _MOST_BYTES:
                    raise NoAnswer(f"the answer is longer than {_MOST_BYTES} bytes; check the URL")
                if REAL.monotonic() > end:
                    raise NoAnswer(too_slow)
            return HttpAnswer(
                answer.status_code,
                answer.reason_phrase,
                content,
                # GitHub answers too many calls with 403 and one of these headers
                answer.status_code == 429
                or (answer.is_error and "retry-after" in answer.headers)
                or (answer.is_error and answer.headers.get("x-ratelimit-remaining") == "0"),
            )
    except httpx.TimeoutException:
        raise NoAnswer(too_slow) from None
    except httpx.TransportError as error:
        if cause := _CAUSES.get(type(error).__name__):
            raise NoAnswer(cause) from None
        text = one_line(str(error) or type(error).__name__)
        remedies = (remedy for words, remedy in _REMEDIES if re.search(words, text))
        remedy = next(remedies, "check that the server runs and can be reached")
        raise NoAnswer(f"{text}; {remedy}") from None
    except (httpx.InvalidURL, ValueError):
        raise NoAnswer(_INVALID) from None
    except ImportError:  # httpx needs a further package for SOCKS
        raise NoAnswer("a SOCKS proxy is set, but only HTTP proxies can be used") from None
