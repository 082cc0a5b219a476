"""Text from outside adds no HTML and no command to the page.

The page shows invisible characters of the text as escapes.
"""

from __future__ import annotations

import shlex

from demandops.repo.history.commit_message import PROPOSAL

from tests.integration.web.conftest import VIEWS, Shown
from tests.integration.web.html import Page
from tests.kit import goals
from tests.kit.config import override
from tests.kit.repo import GitRepo, Person, git
from tests.kit.rig import book, wait_until

HOSTILE = "<script>alert(1)</script>\"'><img src=x onerror=alert(1)>{{'zz'*2}}"
HIDDEN = "\u202e"


def test_text_from_outside_stays_text(shown: Shown, person: Person) -> None:
    vehicle = "v<b>&amp;\"x'"
    app = goals.application(f"edge/{HOSTILE}", who=[vehicle])
    book(shown.generator, goals.goal([app], [goals.connection(who=[vehicle])], id=HOSTILE))
    select = {"applications": ["edge/object_detection_fusion"]}
    denial = override(select, deny=True, reason=HOSTILE, owner=HOSTILE)
    files = {"overrides/x.yaml": denial, "inventory/brokers.yaml": f"{HOSTILE}: ["}
    author = HOSTILE.replace("<", "(").replace(">", ")")
    person.change(files, HOSTILE, (author, "x@example.org", 1_790_000_000))
    shown.generator.fetch_now()
    wait_until(lambda: shown.generator.snapshot.problems, "the generator reports the broken file")
    demand = next(
        one.demand for one in shown.generator.snapshot.state.ledger if vehicle in one.requesters
    )
    seen = ""
    for path, params in [*((view, {}) for view in VIEWS), ("/demand", {"id": demand})]:
        for query in ("", HOSTILE):
            page = shown.look(path, q=query, **params)
            _assert_only_ours(page)
            seen += page.text
    assert HOSTILE in seen and vehicle in seen and "zzzz" not in shown.look("/", q=HOSTILE).text
    _assert_only_ours(shown.look("/release", 404, name=HOSTILE))
    _assert_only_ours(shown.look("/demands", 404, at=HOSTILE))


def _assert_only_ours(page: Page) -> None:
    assert [script.attributes["src"] for script in page.all("script")] in (["/static/page.js"], [])
    assert [image.attributes["src"] for image in page.all("img")] in (["/static/icon.svg"], [])
    assert not [name for e in page.elements for name in e.attributes if name.startswith("on")]
    assert page.all("b") == []


def test_a_branch_is_no_command_and_hides_nothing(shown: Shown, state: GitRepo) -> None:
    """An approver pastes the page's command, so a branch's name must not add another command."""
    branch = f"demand/x;$(touch${{IFS}}pwned)|'&{HIDDEN}"
    message = f"Propose\n\n{PROPOSAL}: {HIDDEN}"
    commit = git(state.path, "commit-tree", "main^{tree}", "-p", "main", "-m", message).strip()
    git(state.path, "branch", branch, commit)
    wait_until(lambda: shown.follower.newest.proposals, "the page knows the proposal")
    escaped = branch.replace(HIDDEN, "\\u202e")
    wanted = ["demandops", "approve", escaped, "--commit", commit]
    page = shown.look("/proposals")
    (approve,) = [text for text in page.texts("code") if " approve " in text]
    assert shlex.split(approve) == wanted
    assert f"{approve.replace(' approve ', ' reject ')} -m REASON" in page.texts("code")
    (approve,) = [text for text in shown.look("/").texts("code") if " approve " in text]
    assert shlex.split(approve) == wanted
    assert HIDDEN not in page.text + shown.look("/").text
