"""The commit messages that `git log` shows, and their authors."""

from __future__ import annotations

import re
from collections.abc import Iterator
from datetime import datetime, timezone
from pathlib import Path

import pygit2
import pytest
from demandops.base.errors import fault
from demandops.base.naming import id_problem, one_form
from demandops.base.quoting import harmless, is_visible, one_line
from demandops.decide.decision import Decision
from demandops.decide.state import ReleaseChange
from demandops.model.config.load import load
from demandops.repo.history import commit_log, commit_message
from demandops.repo.history.commit_log import operations_since
from demandops.repo.history.commit_message import compose, parse
from hypothesis import example, given
from hypothesis import strategies as st

from tests.kit import goals, plain_yaml
from tests.kit.chance import examples, visible
from tests.kit.config import state_of
from tests.kit.memory import MemoryRepo
from tests.kit.repo import git
from tests.scenarios.running import configuration
from tests.unit.demand.test_refused import demand_of

NOW = datetime(2026, 3, 1, 12, 0, 7, tzinfo=timezone.utc)


def join(*requesters: str, id: str = "intersection", application: str = "edge/fusion") -> Decision:
    app = goals.application(application, who=requesters, clouds=[goals.STATION_CLOUD])
    return MemoryRepo(now=NOW).send(goals.goal([app], id=id))


FILE = Path(__file__).with_name("commit-messages.txt")
TEXTS = plain_yaml.beside(__file__, "texts")


def messages() -> Iterator[tuple[str, str]]:
    """Yield the text of each kind of commit, with what it is for."""
    for title, demands in TEXTS["messages"].items():
        desk = MemoryRepo(now=NOW)
        *_, decision = [desk.send(demand_of(one)) for one in demands]
        yield title, commit_message.of_decision(decision, "op-1", NOW)
    releases = [ReleaseChange("of-edge", "object-fusion on edge", "", "change", ("- replicas 1",))]
    problems = [fault("nodes[0].id", "appears twice; remove one").within("inventory/nodes.yaml")]
    ids, how = ("c" * 40, "b" * 40), "correct the files, or undo the commits: git revert cccc"
    followed = commit_message.of_follow(releases, *ids, "", [], "")
    yield "a commit that follows one of a person", followed
    held = commit_message.of_follow([], *ids, "b" * 40, problems, how)
    yield "a commit that follows one whose configuration is not valid", held
    put_back = commit_message.of_follow([], *ids, "", problems, "")
    yield "a commit that puts a claim back", put_back
    long = join("vehicle00", application="edge/" + "fusion" * 40)
    yield "a long id", commit_message.of_decision(long, "op-1", NOW).split("\n")[0]
    full = MemoryRepo(state=state_of(load(configuration(config=TEXTS["full"]))))
    for wanted in TEXTS["waiting"]:
        yield "a demand that waits", commit_message.of_decision(full.send(wanted), "op", full.now)


def listing() -> str:
    return "".join(f"==== {title} ====\n{text.rstrip()}\n\n" for title, text in messages())


def test_messages_are_those_of_the_file() -> None:
    assert listing() == FILE.read_text(), f"run python -m {__name__} and review the diff"


@pytest.mark.parametrize(("names", "wanted"), TEXTS["authors"])
def test_the_author_is_the_requesters_as_listed_and_never_a_person(
    names: list[str], wanted: str
) -> None:
    decision = join(*names)
    who = commit_message.author(decision, NOW)
    assert who.name == wanted
    demand = decision.changes.claims[0].key.demand
    assert who.email == f"{demand}@requester.demandops.invalid"
    assert (who.time, who.offset) == (int(NOW.timestamp()), 0)


# ---- a message is read back as it was written, whatever text its values have ----


HOSTILE = [*TEXTS["hostile"], "\ud800", "\ud83d\ude97", "x" * 100_000]
FORGES, ORDERS = TEXTS["forges"], TEXTS["orders"]
VALUES = st.one_of(
    st.sampled_from(HOSTILE),
    st.text(),
    st.text('"\\ x20u{n\n:', min_size=1),
    st.lists(st.sampled_from(HOSTILE[1:]), min_size=2, max_size=4).map("".join),
).filter(bool)
KEYS = st.from_regex(r"[A-Za-z][A-Za-z0-9-]{0,20}", fullmatch=True)
TRAILERS = st.lists(st.tuples(KEYS, VALUES), min_size=1, max_size=6)


@given(paragraphs=st.lists(st.lists(VALUES, min_size=1), min_size=1, max_size=3), trailers=TRAILERS)
@example(paragraphs=[["Join a"]], trailers=[("Requester", value) for value in HOSTILE])
@examples(30)
def test_trailers_are_read_back_exactly_and_nothing_else_stands_in_the_message(
    paragraphs: list[list[str]], trailers: list[tuple[str, str]]
) -> None:
    text = compose(paragraphs, trailers)
    assert all(is_visible(line) for line in text.split("\n"))
    wanted: dict[str, list[str]] = {}
    for key, value in trailers:
        wanted.setdefault(key, []).append(value)
    found = parse(text)
    assert found.trailers == wanted
    assert found.summary == harmless(one_line(paragraphs[0][0]))
    lines = [harmless(one_line(line)) for paragraph in paragraphs for line in paragraph]
    above = text.removesuffix("\n").rpartition("\n\n")[0].split("\n")
    assert [line for line in above if line] == [line for line in lines if line]


def _trailers_of_git(repo: pygit2.Repository, text: str) -> str:
    who = pygit2.Signature("x", "x@example.org", 0, 0)
    commit = repo.create_commit(None, who, who, text, repo.TreeBuilder().write(), [])
    assert repo[commit].peel(pygit2.Commit).message == text
    shown = ("log", "-1", "--encoding=UTF-8", "--format=%(trailers:only)", str(commit))
    return git(repo.path, *shown).strip()


@given(text=st.lists(st.sampled_from(ORDERS), min_size=1, max_size=6).map("".join))
@example(text=" ".join(ORDERS))
@examples(80)
def test_no_forge_acts_on_what_a_requester_writes(repo: pygit2.Repository, text: str) -> None:
    why = f"Why: request '{text}', asks for {text}."
    paragraphs = [[f"Join {text}"], [why], ["List:", f"  {text}"]]
    trailers = [("Requester", text), ("Demand-Id", text), ("Override", f"overrides/{text}.yaml")]
    message = compose(paragraphs, trailers)
    assert {what for what, acts in FORGES.items() if re.search(acts, message)} == set()
    assert [(key, value) for key, [value] in parse(message).trailers.items()] == trailers
    assert _trailers_of_git(repo, message) == compose([], trailers).strip()


def test_the_patterns_find_what_is_not_made_harmless() -> None:
    found = {what for what, acts in FORGES.items() if re.search(acts, "\n".join(ORDERS))}
    assert found == set(FORGES)


def test_a_person_may_close_an_issue_with_a_reason() -> None:
    message = compose([["Roll back"]], [("Reason", "[no ci] Fixes #1, @anna"), ("Requester", "#1")])
    assert message == 'Roll back\n\nReason: [no ci] Fixes #1, @anna\nRequester: "\\x231"\n'


def test_messages_of_earlier_versions_are_read_as_they_were_meant() -> None:
    values = ["Fixes #1", "@a", '"', "\\", '"a"', "a: b", "a\u200bb", '"\\\'"', "a\\x41"]
    text = "".join(f"Requester: {value}\n" for value in values)
    assert parse(f"Join a\n\n{text}").trailers["Requester"] == values


@pytest.mark.parametrize(("text", "wanted"), TEXTS["trailers"].items())
def test_trailers_are_the_last_paragraph_if_it_holds_nothing_else(
    text: str, wanted: dict[str, list[str]]
) -> None:
    assert parse(text).trailers == wanted


NASTY = [*TEXTS["ids"], "x" * 300, "ü" * 300, "🚗" * 300]
IDS = st.one_of(
    st.text(visible, min_size=1, max_size=60).filter(lambda text: not id_problem(text)),
    st.sampled_from(NASTY),
).map(one_form)  # as goals bring them


@given(names=st.lists(IDS, min_size=1, max_size=3, unique=True), request=IDS, application=IDS)
@examples(30)
def test_every_id_is_read_back_by_git_and_by_us_as_it_was(
    repo: pygit2.Repository, names: list[str], request: str, application: str
) -> None:
    decision = join(*names, id=request, application=application)
    text = commit_message.of_decision(decision, "op-1", NOW)
    who = commit_message.author(decision, NOW)
    assert who.name.strip() and len(who.name) <= 200
    tree = repo.TreeBuilder().write()
    committer = commit_message.generator_signature(NOW)
    commit = repo.create_commit(None, who, committer, text, tree, [])
    ours = commit_log.entry_of(repo[commit].peel(pygit2.Commit)).trailers
    assert ours["Requester"] == names
    assert ours["Request-Id"] == [request]
    assert ours["Application"] == [application]
    trailers = "--format=%(trailers:only,unfold)"
    by_git = git(repo.path, "log", "-1", "--encoding=UTF-8", trailers, str(commit))
    lines = compose([], [(key, value) for key, values in ours.items() for value in values])
    assert sorted(by_git.split("\n")) == sorted(lines.split("\n"))


# ---- which demands arrived ----


def _commit(repo: pygit2.Repository, operation: str, *parents: pygit2.Oid) -> pygit2.Oid:
    name = commit_message.GENERATOR_NAME if operation else "x"
    who = pygit2.Signature(name, commit_message.GENERATOR_EMAIL, 0, 0)
    text = f"Join\n\nOperation-Id: {operation}\nRender-Version: 1\n" if operation else "By hand\n"
    return repo.create_commit(None, who, who, text, repo.TreeBuilder().write(), list(parents))


def test_operations_that_arrived_after_a_commit_are_found_and_no_others(
    repo: pygit2.Repository,
) -> None:
    first = _commit(repo, "op-1")
    second = _commit(repo, "op-2", first)
    tip = _commit(repo, "op-3", _commit(repo, "", second))
    beside = _commit(repo, "op-9", first)

    def found(base: object) -> dict[str, str]:
        return {name: a.commit for name, a in operations_since(repo, tip, str(base)).items()}

    assert found(first) == {"op-2": str(second), "op-3": str(tip)}
    assert found(tip) == {}
    everything = {"op-1": str(first), "op-2": str(second), "op-3": str(tip)}
    for none in ("", "0" * 40, "no commit", beside):  # `beside` is on another branch
        assert found(none) == everything


if __name__ == "__main__":
    FILE.write_text(listing())
