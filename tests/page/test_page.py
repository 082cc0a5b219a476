"""The page in a real browser, for a mouse, a keyboard, a phone and a screen reader."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from axe_playwright_python.sync_playwright import Axe
from demandops.base.naming import SubjectKind
from demandops.repo.reader import Reader
from demandops.web.follower import Follower
from demandops.web.server import WebServer
from playwright.sync_api import Browser, Route, expect

from tests.e2e.rig.net import free_port
from tests.kit import repo
from tests.kit.browser import Visit, chromium
from tests.kit.http import Answer, serving
from tests.kit.limits import PATIENCE_S
from tests.kit.rig import book
from tests.page.story import FAILING, Story, leased, released, story

expect.set_options(timeout=PATIENCE_S * 1000)


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Story]:
    folder = tmp_path_factory.mktemp("fleet")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DEMANDOPS_DATA_HOME", str(folder / "home"))
        with story(repo.init(folder / "fleet.git"), folder) as told:
            yield told


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    with chromium() as running:
        yield running


Visits = Callable[..., Visit]


@pytest.fixture
def visit(browser: Browser, fleet: Story) -> Iterator[Visits]:
    """Return a function that opens the page in the browser and returns the :class:`Visit`.

    After the test, the fixture checks that the page called no other host and reported no error.
    """
    made: list[Visit] = []

    def start(**options: Any) -> Visit:
        made.append(Visit(browser, fleet.url, **options))
        return made[-1]

    yield start
    for one in made:
        one.close()
    assert {host for one in made for host in one.hosts} <= {fleet.url.removeprefix("http://")}
    assert [text for one in made for text in one.complaints] == []


FIGURES = Path(__file__).parents[2] / "docs" / "figures"


BUILD = Path(__file__).parents[2] / "build" / "page"
VIEWS = [
    *("", "map", "map?q=vehicle00", "demands", "services", "connections", "leases", "timeline"),
    *("timeline?at=HEAD~2", f"release?name={FAILING}", "demand?id=vehicle01-to-cloud"),
    *(
        "overrides",
        "demands?gone=1",
        "thing?kind=node&name=edge",
        "thing?kind=requester&name=vehicle00",
    ),
]
SERIOUS = ("serious", "critical")
BROKEN_WORDS, OUT_OF_ITS_CARD = (
    Path(__file__).with_name(f"{name}.js").read_text()
    for name in ("broken-words", "out-of-its-card")
)


def picture(view: str, of: str) -> Path:
    """Return the file for a screenshot of a view, which people may look at."""
    BUILD.mkdir(parents=True, exist_ok=True)
    return BUILD / f"{re.sub(r'[^a-z0-9]+', '-', view.lower()) or 'start'}-{of}.png"


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_every_view_is_accessible(visit: Visits, scheme: str) -> None:
    """axe-core finds nothing serious in any view; the fixture `visit` checks the console too."""
    seen, axe = visit(color_scheme=scheme), Axe()
    for view in VIEWS:
        page = seen.open(f"/{view}")
        expect(page.locator("main h1")).to_be_visible()
        page.evaluate("document.querySelectorAll('details').forEach((one) => { one.open = true })")
        found = [one for one in axe.run(page).response["violations"] if one["impact"] in SERIOUS]
        assert [(one["id"], one["nodes"][0]["html"]) for one in found] == []
        seen.open(f"/{view}").screenshot(path=picture(view, scheme))


@pytest.mark.parametrize("width", [360, 768, 1280])
def test_nothing_overflows_and_no_word_is_broken(visit: Visits, width: int) -> None:
    """No view is wider than the screen, and a line ends within a word only if it is a long one."""
    seen = visit(width=width)
    for view in VIEWS:
        page = seen.open(f"/{view}")
        page.screenshot(path=picture(view, str(width)), full_page=True)
        wide = page.evaluate("document.documentElement.scrollWidth")
        assert wide <= width, f"{view} is {wide} wide"
        cut = "links => links.filter(l => l.getBoundingClientRect().right > innerWidth).length"
        assert page.eval_on_selector_all("header nav a", cut) == 0, "the menu is cut"
        assert page.evaluate(BROKEN_WORDS) == [], view


def test_an_update_of_the_page_keeps_the_focus_and_the_typed_text(
    visit: Visits, fleet: Story
) -> None:
    page = visit().open("/demands?q=vehicle01")
    expect(page.locator("#live")).to_have_text("live")
    link = page.get_by_role("link", name="vehicle01-to-cloud").first
    link.focus()
    page.locator("#q").evaluate("(field) => { field.value = 'half typ' }")
    book(fleet.generator, leased("vehicle01-too", "vehicle01"))
    expect(page.get_by_role("link", name="vehicle01-too").first).to_be_visible()
    assert page.evaluate("document.activeElement.textContent") == "vehicle01-to-cloud"
    assert page.locator("#q").input_value() == "half typ"
    expect(page.get_by_role("status")).to_have_text("updated")


def test_the_filter_works_while_typing_and_links_keep_it(visit: Visits) -> None:
    page = visit().open("/services")
    expect(page.locator("tbody tr")).to_have_count(3)
    page.keyboard.press("/")
    page.keyboard.type("requester=vehicle03")
    expect(page.locator("tbody tr")).to_have_count(2)
    assert page.url.endswith("/services?q=requester%3Dvehicle03")
    page.get_by_role("navigation", name="Views").get_by_role("link", name="Connections").click()
    expect(page.locator("tbody tr")).to_have_count(1)
    assert page.locator("#q").input_value() == "requester=vehicle03"


def test_a_keyboard_reaches_everything(visit: Visits) -> None:
    page = visit().open("/map")
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.textContent") == "Skip to the content"
    page.keyboard.press("Enter")
    for _ in range(30):
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement.classList.contains('node')"):
            break
    page.keyboard.press("Enter")
    page.wait_for_url("**/thing?kind=node&**")
    expect(page.locator("h1")).to_contain_text("Node ")


def test_a_dot_of_the_time_line_opens_the_books_of_then(visit: Visits) -> None:
    page = visit().open("/timeline?lane=demands&span=1h")
    page.locator("a .dot").first.click()
    expect(page.locator(".moment")).to_contain_text("The state of")
    page.get_by_role("navigation", name="Views").get_by_role("link", name="Demands").click()
    expect(page.locator(".moment")).to_contain_text("The state of")
    page.get_by_role("link", name="Back to now").click()
    expect(page.locator(".moment")).to_have_count(0)


def test_it_works_without_scripts(visit: Visits) -> None:
    page = visit(java_script_enabled=False).open("/")
    expect(page.locator(".cause").first).to_contain_text("manifest unknown")
    page.get_by_role("link", name="Releases", exact=True).click()
    page.locator("#q").fill("od-edge-vehicle00")
    page.locator("#q").press("Enter")
    expect(page.locator("tbody tr")).to_have_count(1)


def test_health_is_live(visit: Visits, fleet: Story) -> None:
    page = visit().open(f"/release?name={FAILING}")
    expect(page.locator("h1 .badge")).to_have_text("failing")
    fleet.settle(mended=True)
    expect(page.locator("h1 .badge")).to_have_text("healthy")
    page.goto(f"{fleet.url}/timeline?lane=health&q={FAILING}")
    expect(page.locator(".events tbody tr").first).to_contain_text("was failing, is healthy")
    fleet.settle()
    page.goto(f"{fleet.url}/")
    expect(page.locator(".cause.bad").first).to_contain_text("manifest unknown")


def test_what_changes_between_the_page_and_its_first_event_is_shown(
    visit: Visits, fleet: Story
) -> None:
    def change_first(route: Route) -> None:
        book(fleet.generator, leased("just-now", "vehicle03"))
        fleet.wait_followed()
        route.continue_()

    opened = visit()
    opened.page.route("**/events", change_first, times=1)
    page = opened.open("/demands")
    expect(page.locator("main")).to_contain_text("just-now")


def test_the_page_follows_again_when_its_server_is_back(browser: Browser, fleet: Story) -> None:
    def serve(address: str) -> WebServer:
        return WebServer(address, "--listen", Follower(Reader.of(str(fleet.bare)), {}, 0))

    server = serve(f"127.0.0.1:{free_port()}")
    visit = Visit(browser, server.url.rstrip("/"))
    page, address = visit.open("/demands"), urlsplit(server.url).netloc
    expect(page.locator("#live")).to_have_text("live")
    server.close()
    # as a reverse proxy while its server is down; after a 502 the browser reopens no stream itself
    port = address.rpartition(":")[2]
    with serving(lambda call: Answer(502), int(port)):
        expect(page.locator("#live")).to_have_text("not current: waiting for the server")
        with page.expect_response(lambda answer: answer.status == 502):
            pass
    book(fleet.generator, leased("meanwhile", "vehicle03"))
    server = serve(address)
    expect(page.locator("main")).to_contain_text("meanwhile")
    visit.close()
    server.close()


def test_a_demand_that_ended_is_told_at_once(browser: Browser, fleet: Story) -> None:
    book(fleet.generator, leased("short", "vehicle03"))
    fleet.wait_followed()
    visit = Visit(browser, fleet.url)
    page = visit.open("/demand?id=short")
    expect(page.locator("h1")).to_have_text("Demand short held")
    expect(page.locator("#live")).to_have_text("live")
    book(fleet.generator, released("short", "vehicle03"))
    expect(page.locator("h1")).to_have_text("Demand short gone")
    visit.close()


def test_the_figures_of_the_docs_come_from_here(visit: Visits, tmp_path: Path) -> None:
    for name, path in {"page": "/", "page-map": "/map?q=vehicle00"}.items():
        file = tmp_path / f"{name}.png"
        clip = {"x": 0, "y": 0, "width": 1180, "height": 620}
        visit(width=1180).open(path).screenshot(path=file, clip=clip)
        assert file.stat().st_size < 200_000
        if os.environ.get("FIGURES"):
            FIGURES.mkdir(exist_ok=True)
            shutil.copy(file, FIGURES / file.name)
        assert (FIGURES / file.name).stat().st_size < 200_000


LONG = "/vehicles/vehicle01/drivers/the_front_lidar_of_the_roof/pointcloud_without_ground"


def test_long_names_scroll_no_page_sideways(visit: Visits, fleet: Story) -> None:
    reads = {"point_cloud": [{"topic": LONG, "source": "vehicle01"}]}
    app = {"id": "edge/view", "type": "object-detection-fusion", "node": "edge", "inputs": reads}
    goal = {"kind": "Demand", "demand": "view", "requesters": ["vehicle01"], "applications": [app]}
    connection = f"derived/vehicle01/edge{LONG}"
    try:
        book(fleet.generator, goal)
        fleet.wait_followed()
        assert connection in fleet.follower.newest.state.ledger.subjects(SubjectKind.CONNECTION)
        seen = visit(width=390)
        for view in (
            *VIEWS,
            "thing?kind=demand&name=view",
            f"thing?kind=connection&name={connection}",
        ):
            page = seen.open(f"/{view}")
            page.screenshot(path=picture(view, "390"), full_page=True)
            wide = page.evaluate("document.documentElement.scrollWidth")
            assert wide <= 390, f"{view} is {wide} wide"
            out = page.evaluate(OUT_OF_ITS_CARD)
            assert out == [], view
    finally:
        book(fleet.generator, released("view", "vehicle01"))
        fleet.wait_followed()
