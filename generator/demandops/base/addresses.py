"""Names with parts inside: hosts, endpoints, URLs, addresses of Git, container images and charts.

Each kind is taken apart in one place. A ValueError says what is wrong, and what to write instead.
"""

from __future__ import annotations

import ipaddress
import re
from contextlib import suppress
from dataclasses import dataclass
from urllib.parse import SplitResult, urlsplit

from demandops.base.quoting import quoted

# ---- hosts, alone and with a port ----

_WORD = "[A-Za-z0-9_]([A-Za-z0-9_-]*[A-Za-z0-9_])?"
_HOST_NAME = re.compile(rf"(?=.{{1,253}}$)(?![0-9.]+$){_WORD}(\.{_WORD})*")


def is_ip(host: str) -> bool:
    try:
        return "%" not in host and bool(ipaddress.ip_address(host))
    except ValueError:
        return False


def in_url(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def host(text: str) -> str:
    if is_ip(text) or _HOST_NAME.fullmatch(text):
        return text
    raise ValueError(
        f"{quoted(text)} is not a host; write a name or an IP address alone, without scheme, "
        "brackets and port, such as broker.example, 10.0.0.1 or 2001:db8::1"
    )


def _host_and_port(text: str) -> tuple[str, int] | None:
    # of `host`, `host:80` or `[2001:db8::1]:80`; port 0 if there is none
    match = re.fullmatch(
        r"(?:\[(?P<v6>[^]]*:[^]]*)\]|(?P<name>[^:\[\]]*))(?::(?P<port>[0-9]{0,5}))?", text
    )
    with suppress(ValueError):
        if match and (match["port"] is None or 0 < int(match["port"]) < 1 << 16):
            return host(match["v6"] or match["name"]), int(match["port"] or 0)
    return None


def endpoint(text: str) -> tuple[str, str, int]:
    """Take an endpoint of Zenoh apart, whose protocol needs no certificates."""
    protocol, _, address = text.partition("/")
    name, port = _host_and_port(address) or ("", 0)
    if protocol in ("tcp", "udp", "ws") and port:
        return protocol, name, port
    raise ValueError(
        f"{quoted(text)} is not an endpoint of Zenoh; write tcp/HOST:PORT (or udp/…, ws/…), such "
        "as tcp/router.example:7447 or tcp/[2001:db8::1]:7447"
    )


# ---- URLs ----

# The host of a URL with its port, up to where its path or the text around it begins
_PLAIN_HOST = r"(?:\[[^][@/\s]+\]|[^/@\s:\[\]?#'\"]+)(?::[0-9]*)?(?=[/?#\s'\",;)>]|$)"
# Matches the user and password of a URL in a text. If what follows `://` is no host, a password may
# hold any character, even a slash.
_USER = re.compile(rf"(?<=://)(?!/)(?:[^/\s]*@(?={_PLAIN_HOST})|(?!{_PLAIN_HOST})\S*@)")
# A user name that is a token. Other user names are allowed, because some forges need one.
_TOKEN = re.compile(
    r"gh[a-z]_|github_pat_|gl[a-z]+-|ATBB|ATCTT|(?=[a-z]*\d)[a-z0-9]{32,}@$", re.IGNORECASE
)
_SCP = re.compile(
    r"(?P<user>[^\s:@/]+)@(?P<host>\[[^\s@/\]]+\]|[^\s:@/]+):(?!\d+/)(?P<path>[^\s/]\S*)"
)


def without_secrets(text: str) -> str:
    """Return a text without the users and passwords of the URLs in it."""
    return _USER.sub("", text)


def holds_secret(url: str) -> bool:
    user = _USER.search(url)
    is_web = url.startswith(("http://", "https://"))
    return bool(user and (":" in user[0] or "/" in user[0] or (is_web and _TOKEN.match(user[0]))))


def as_git_url(text: str) -> str:
    # `git@host:path` is Git's short form of a URL
    scp = _SCP.fullmatch(text)
    return f"ssh://{scp['user']}@{scp['host']}/{scp['path']}" if scp else text


def url(text: str, *schemes: str) -> SplitResult:
    with suppress(ValueError):  # of brackets that are no IPv6 address
        parts = urlsplit(text)
        if (
            text.startswith(tuple(f"{scheme}://" for scheme in schemes))
            and _host_and_port(parts.netloc.rpartition("@")[2])
            and text.isprintable()
            and not re.search(r"[\s\\]", text)
            and "//" not in parts.path
        ):
            return parts
    forms = " or ".join(f"{scheme}://HOST/PATH" for scheme in schemes)
    raise ValueError(f"{quoted(without_secrets(text))} is not a URL that works here; write {forms}")


# ---- images and charts: the grammar of distribution's references ----

_COMPONENT = re.compile(r"[a-z0-9]+(?:(?:\.|_|__|-+)[a-z0-9]+)*")
_TAG = re.compile("[A-Za-z0-9_][A-Za-z0-9_.-]{0,127}")
_DIGEST = re.compile("sha256:[0-9a-f]{64}")


@dataclass(frozen=True, slots=True)
class ImageReference:
    """``host/path:tag@digest``; only the path must be there."""

    host: str
    path: str
    tag: str
    digest: str

    @property
    def name(self) -> str:
        return f"{self.host}/{self.path}" if self.host else self.path


def image(text: str) -> ImageReference:
    first = text.partition("/")[0]
    # Docker's rule: only such a first part is a host
    has_host = "/" in text and ("." in first or ":" in first or first == "localhost")
    if reference := _reference(text, has_host=has_host):
        return reference
    plain = re.sub("/{2,}", "/", text.partition("://")[2] or text).strip("/").lower()
    hint = "registry.example/team/detection" if plain == text or "@" in plain else plain
    raise ValueError(
        f"{quoted(text)} is not the name of an image; write HOST/PATH in lower case, without "
        f"scheme, '//' and '/' at the end, such as {hint}"
    )


def repository(text: str) -> ImageReference:
    """Take an image's name apart; it must have neither tag nor digest."""
    reference = image(text)
    for field in ("digest", "tag"):
        if value := getattr(reference, field):
            raise ValueError(
                f"{quoted(text)} has a {field}, which has a field of its own; write "
                f"{reference.name} here, and {quoted(value)} as '{field}'"
            )
    return reference


def registry(text: str) -> str:
    try:
        repository(f"{text}/x")
    except ValueError:
        raise ValueError(
            f"{quoted(text)} is not a registry; write HOST, HOST:PORT or HOST/PATH in lower case, "
            "without scheme and '/' at the end, such as registry.example/team"
        ) from None
    return text


def oci_chart(text: str) -> ImageReference:
    _without_user(text)
    reference = _reference(text.removeprefix("oci://"), has_host=True)
    if not text.startswith("oci://") or reference is None:
        raise ValueError(
            f"{quoted(text)} is not the address of a chart; write oci://HOST/PATH in lower case, "
            "without '//' in the path and '/' at the end"
        )
    if reference.tag or reference.digest:
        raise ValueError(
            f"{quoted(text)} has a version in it; write oci://{reference.name} here, and the "
            f"version as 'version'{f': {reference.tag}' if reference.tag else ''}"
        )
    return reference


def _reference(text: str, *, has_host: bool) -> ImageReference | None:
    before, at, digest = text.partition("@")
    head, slash, last = before.rpartition("/")
    last, colon, tag = last.partition(":")
    name = f"{head}{slash}{last}"
    first, _, path = name.partition("/") if has_host else ("", "", name)
    is_valid = (
        len(name) <= 255
        and (not has_host or (_host_and_port(first) and first == first.lower()))
        and all(map(_COMPONENT.fullmatch, path.split("/")))
        and (_TAG.fullmatch(tag) or not colon)
        and (_DIGEST.fullmatch(digest) or not at)
    )
    return ImageReference(first, path, tag, digest) if is_valid else None


def http_chart(text: str) -> SplitResult:
    _without_user(text)
    parts = url(text, "https", "http")
    if parts.query or parts.fragment or parts.path.endswith((".tgz", "/index.yaml")):
        raise ValueError(
            f"{quoted(text)} is not the address of a chart repository; write that of the folder "
            "in which its index.yaml is, without '?' and '#'"
        )
    return parts


def _without_user(text: str) -> None:
    if without_secrets(text) != text:
        raise ValueError(
            "must not contain a user or password; give them to the GitOps controller as a Secret"
        )
