"""The site is read-only, and its answers forbid browsers all that the page does not need."""

from __future__ import annotations

from pathlib import Path

import pytest
from demandops.base.errors import InvalidInput
from demandops.repo.reader import Reader
from demandops.web.follower import Follower
from demandops.web.server import Site, WebServer
from starlette.testclient import TestClient

from tests.integration.web.conftest import VIEWS, Shown
from tests.integration.web.html import Page
from tests.kit import plain_yaml

ASKED = plain_yaml.beside(__file__)


@pytest.mark.parametrize("path", VIEWS)
def test_every_answer_forbids_what_the_page_does_not_need(still: Shown, path: str) -> None:
    answer = still.client.get(path)
    policy = answer.headers["content-security-policy"]
    assert policy.startswith("default-src 'none'; script-src 'self'; style-src 'self';")
    assert "unsafe" not in policy
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers["cache-control"] == "no-store"
    page = Page(answer.text)
    for element in page.elements:
        assert "style" not in element.attributes
        assert not [name for name in element.attributes if name.startswith("on")]
        for name in ("src", "href", "action"):
            address = element.attributes.get(name, "/")
            assert address.startswith(("/", "#")) and not address.startswith("//")
    assert [script.text for script in page.all("script")] == [""]
    assert page.all("style") == []


def test_nothing_can_be_sent(still: Shown) -> None:
    for method in ("POST", "PUT", "PATCH", "DELETE"):
        assert {still.client.request(method, path).status_code for path in (*VIEWS, "/events")} == {
            405
        }


def test_the_documentation_comes_with_the_page_where_it_was_built(
    still: Shown, tmp_path: Path
) -> None:
    assert "Documentation" not in still.client.get("/").text
    assert still.client.get("/docs/index.html").status_code == 404
    tmp_path.joinpath("index.html").write_text("<script>1</script>")
    site = Site(still.follower, documentation=tmp_path)
    client = TestClient(site.application)
    assert '<a href="/docs/index.html">Documentation</a>' in client.get("/").text
    page = client.get("/docs/index.html")
    assert page.text == "<script>1</script>"
    assert "script-src 'self' 'unsafe-inline'" in page.headers["Content-Security-Policy"]
    assert client.get("/docs/..%2fsite.py").status_code == 404
    for path in ("/", "/docs", "/docsy"):
        assert "default-src 'none'" in client.get(path).headers["Content-Security-Policy"]


def test_another_name_of_this_machine_is_refused(still: Shown) -> None:
    """Else another site, whose name points to this machine, reads the page (DNS rebinding)."""
    refused = still.client.get("/", headers={"Host": "attacker.example"})
    assert refused.status_code == 400
    assert still.client.get("/", headers={"Host": "localhost:8080"}).status_code == 200


@pytest.mark.parametrize("case", ASKED["elsewhere"])
def test_what_another_site_makes_a_browser_ask_is_refused(still: Shown, case: str) -> None:
    for path in ("/", "/services?at=HEAD", "/events", "/health", "/static/page.js"):
        refused = still.client.get(path, headers=ASKED["elsewhere"][case])
        assert refused.status_code == 403
        assert "default-src 'none'" in refused.headers["Content-Security-Policy"]


def test_what_the_page_or_its_visitor_asks_is_answered(still: Shown) -> None:
    here = ASKED["here"]
    answers = {case: still.client.get("/", headers=here[case]).status_code for case in here}
    assert answers == dict.fromkeys(here, 200)


def test_an_address_that_others_reach_is_warned_of(
    still: Shown, caplog: pytest.LogCaptureFixture
) -> None:
    server = WebServer("0.0.0.0:0", "--listen", Follower(Reader.of(str(still.bare)), {}, 0))
    server.close()
    assert "everybody who reaches http://0.0.0.0:" in caplog.text


def test_an_address_that_cannot_be_used_is_named_and_the_follower_ends(still: Shown) -> None:
    follower = Follower(Reader.of(str(still.bare)), {}, 0)
    with pytest.raises(InvalidInput) as told:
        WebServer("8080", "--web", follower)
    assert follower.closed.is_set()
    assert str(told.value).startswith("--web: '8080' is not an address to listen on")
