"""The generator reads the same trailers from a commit message as git itself."""

from __future__ import annotations

from typing import Any

import pygit2
import pytest
from demandops.base.naming import id_problem
from demandops.repo.history import commit_log, commit_message
from demandops.repo.history.commit_log import operations_since
from demandops.repo.history.commit_message import compose, parse
from hypothesis import given
from hypothesis import strategies as st

from tests.kit.chance import examples, visible
from tests.kit.repo import git
from tests.unit.repo.test_message_format import TEXTS


@pytest.mark.parametrize(("text", "wanted"), TEXTS["trailers"].items())
def test_trailers_are_the_last_paragraph_if_it_holds_nothing_else(
    text: str, wanted: dict[str, list[str]]
) -> None:
    assert parse(text).trailers == wanted


NASTY = [*TEXTS["ids"], "x" * 300, "ü" * 300, "🚗" * 300]
IDS = st.one_of(
    st.text(visible, min_size=1, max_size=60).filter(lambda text: not id_problem(text)),
    st.sampled_from(NASTY),
)


@given(names=st.lists(IDS, min_size=1, max_size=3, unique=True), request=IDS, application=IDS)
@examples(30)
def test_every_id_is_read_back_by_git_and_by_us_as_it_was(
    desk: Any, repo: pygit2.Repository, names: list[str], request: str, application: str
) -> None:
    decision = type(desk)().join(*names, id=request, application=application)
    text = commit_message.of_decision(decision, "op-1", desk.now)
    who = commit_message.author(decision, desk.now)
    assert who.name.strip() and len(who.name) <= 200
    tree = repo.TreeBuilder().write()
    committer = commit_message.generator_signature(desk.now)
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
