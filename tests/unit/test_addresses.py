"""Names with parts inside are taken apart by their grammar, or refused with what to write."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from demandops.base import addresses
from demandops.model.config.inventory import Zenoh
from demandops.model.config.registry import Image
from demandops.model.config.repo_settings import ArgoCd, Proposals
from pydantic import ValidationError

HEX = "a" * 64
TAKEN: dict[Callable[[str], Any], list[str]] = {
    addresses.repository: [
        "docker.io/rwthika/client", "client", "team/client", "localhost/x", "localhost:5000/x",
        "10.0.0.1:5000/x", "[2001:db8::1]:5000/a/b", "ghcr.io/a__b/c--d.e", "my_registry.lan/x",
    ],
    addresses.image: ["x:1", f"ghcr.io/a/b@sha256:{HEX}", f"h:80/x:1@sha256:{HEX}"],
    addresses.registry: ["localhost:5000", "ghcr.io", "ghcr.io/team", "[::1]:5000", "mirror"],
    addresses.oci_chart: ["oci://ghcr.io/a/b", "oci://registry/x", "oci://[::1]:5000/charts/x"],
    addresses.http_chart: ["https://charts.example/x", "http://[::1]:80/x/", "https://h"],
    addresses.host: ["edge", "a-b.example", "10.0.0.1", "::1", "2001:db8::1", "broker_1"],
    addresses.endpoint: ["tcp/h:7447", "udp/10.0.0.1:1", "ws/[::1]:65535", "tcp/0.0.0.0:7447"],
}  # fmt: skip
# what is refused, and what the refusal says to write
REFUSED: dict[Callable[[str], Any], dict[str, str]] = {
    addresses.repository: {
        "ghcr.io/a/b:1.0": "write ghcr.io/a/b here, and '1.0' as 'tag'",
        f"ghcr.io/a@sha256:{HEX}": f"write ghcr.io/a here, and 'sha256:{HEX}' as 'digest'",
        "x:1": "write x here, and '1' as 'tag'",
        "https://ghcr.io/a/b": "such as ghcr.io/a/b",
        "oci://ghcr.io/a": "such as ghcr.io/a",
        "ghcr.io/a/b/": "such as ghcr.io/a/b",
        "ghcr.io//b": "such as ghcr.io/b",
        "ghcr.io/A/b": "such as ghcr.io/a/b",
        "GHCR.io/a": "such as ghcr.io/a",
        **dict.fromkeys(
            ["", "/", "a..b", "a___b", "-a", "a b", "h:99999/x", "h:0/x", "::1/x", "[a]:1/x", "x:",
             "10.0.0.300/x", "u:p@h/x", "a@md5:1", "a/" * 200 + "a", "a\nb", "a/٣"],
            "is not the name of an image",
        ),
    },
    addresses.registry: dict.fromkeys(
        ["ghcr.io/", "https://ghcr.io", "ghcr.io/a:1", "A.io", "", "h:70000", "ghcr.io//a"],
        "is not a registry; write HOST, HOST:PORT or HOST/PATH",
    ),
    addresses.oci_chart: {
        "oci://ghcr.io/a/x:0.1.0": "write oci://ghcr.io/a/x here, and the version as 'version': 0",
        f"oci://ghcr.io/x@sha256:{HEX}": "write oci://ghcr.io/x here",
        "oci://u:p@ghcr.io/x": "must not contain a user or password",
        **dict.fromkeys(
            ["oci://ghcr.io", "oci://ghcr.io/x/", "oci://ghcr.io//x", "OCI://ghcr.io/x",
             "https://ghcr.io/x", "oci://ghcr.io/X", "oci://", "oci:///x", "oci://h:0/x"],
            "is not the address of a chart; write oci://HOST/PATH",
        ),
    },
    addresses.http_chart: {
        "https://u@h/x": "must not contain a user or password",
        **dict.fromkeys(
            ["https://h/index.yaml", "https://h/x-1.tgz", "https://h/x?y", "https://h/#y"],
            "write that of the folder",
        ),
        **dict.fromkeys(
            ["ftp://h/x", "https://", "https:///x", "https://h:99999/", "https://[::1/", "h/x",
             "https://h//x", "https://h/a b", "https://a:b:c/", "https://::1/", "https://h\\x/"],
            "is not a URL that works here; write https://HOST/PATH",
        ),
    },
    addresses.host: dict.fromkeys(
        ["", "[::1]", "h:1883", "mqtt://h", "h/", "10.0.0.300", "10.0.0", "fe80::1%eth0", "-h",
         "a..b", "a b", "a" * 254],
        "is not a host; write a name or an IP address alone",
    ),
    addresses.endpoint: dict.fromkeys(
        ["tcp/::1:7447", "tcp/h", "tcp/h:0", "tcp/h:65536", "tcp://h:1", "tls/h:1", "h:1",
         "tcp/[h]:1", "tcp/h:1?a", "tcp/h:٣", "tcp/[::1]", "tcp/10.0.0.256:1"],
        "write tcp/HOST:PORT",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("parse", "text"), [(p, text) for p in TAKEN for text in TAKEN[p]])
def test_what_a_grammar_allows_is_taken(parse: Callable[[str], Any], text: str) -> None:
    parse(text)


@pytest.mark.parametrize(
    ("parse", "text", "says"),
    [(p, text, says) for p in REFUSED for text, says in REFUSED[p].items()],
)
def test_a_refusal_says_what_to_write(parse: Callable[[str], Any], text: str, says: str) -> None:
    with pytest.raises(ValueError) as refused:
        parse(text)
    assert says in str(refused.value) and "u:p" not in str(refused.value).partition(";")[2]


def test_a_host_of_a_mirror_replaces_only_a_host() -> None:
    for name, mirrored in {
        "docker.io/a/b": "m:5000/a/b",
        "a/b": "m:5000/a/b",
        "b": "m:5000/b",
    }.items():
        assert Image(repository=name, tag="1").pulled_from("m:5000").repository == mirrored


@pytest.mark.parametrize(
    ("endpoint", "listen"),
    [
        ("tcp/[2001:db8::1]:7447", "tcp/[::]:7447"),
        ("udp/10.0.0.1:1", "udp/0.0.0.0:1"),
        ("ws/h:2", "ws/0.0.0.0:2"),
    ],
)
def test_a_bridge_listens_in_the_family_of_its_endpoint(endpoint: str, listen: str) -> None:
    assert Zenoh(endpoint=endpoint).listening() == (listen,)


@pytest.mark.parametrize(
    ("url", "is_taken"),
    [
        ("http://[2001:db8::1]:3000/fleet/s.git", True),
        ("http://[::1]/team@x/s.git", True),
        ("ssh://git@[::1]:22/s.git", True),
        ("https://me@h/s.git", True),
        ("git@[::1]:s.git", False),
        ("https://h", False),
        ("https://me:secret@h/s.git", False),
        ("https://ghp_0123@h/s.git", False),
        ("https://h:99999/s.git", False),
    ],
)
def test_the_address_of_the_repo_may_be_of_ipv6_but_hold_no_secret(
    url: str, is_taken: bool
) -> None:
    if is_taken:
        assert ArgoCd(url=url).url == url
    else:
        with pytest.raises(ValidationError) as refused:
            ArgoCd(url=url)
        assert "write" in str(refused.value)


def test_a_token_is_sent_to_https_or_to_this_machine() -> None:
    for url in (
        "https://[2001:db8::1]:3000/o/r",
        "http://[::1]:3000/o/r",
        "http://localhost/o/r.git/",
    ):
        assert Proposals(forge="gitea", url=url).project == ("o", "r")
    for url in (
        "http://h/o/r",
        "https://t@h/o/r",
        "https://h//o/r",
        "https://h/o/r?x",
        "http://[::2]/o/r",
    ):
        with pytest.raises(ValidationError):
            Proposals(forge="gitea", url=url)
