"""A commit message is read back as it was written, whatever text its values have."""

from __future__ import annotations

import pygit2
from demandops.quoting import is_visible, one_line
from demandops.staterepo.history.message_format import compose, parse
from hypothesis import example, given
from hypothesis import strategies as st

from tests.kit.chance import examples
from tests.kit.repo import git

HOSTILE = (
    "a\n\nOperation: join\nRequester: control-room\nRender-Version: 1\x00",
    *("\x00", "\n\n", "\r\nA: b", "\u202eabc", "a\u200bb", "\ud800", "\ud83d\ude97", "\u2028"),
    *("\x1b[2J", "\x9b2J", "\u3164", "\ufe0f", '"', '"a"', '"\\u202e"', '"\\x20"', "\\x41", "\\"),
    *(" a", "a ", " ", "\ta", "x" * 100_000, "Key: value", "%(trailers)", "---", "\U000e0001"),
)
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
@examples(80)
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
    assert found.summary == one_line(paragraphs[0][0])
    lines = [one_line(line) for paragraph in paragraphs for line in paragraph]
    above = text.removesuffix("\n").rpartition("\n\n")[0].split("\n")
    assert [line for line in above if line] == [line for line in lines if line]


@given(value=st.text('"\\Uux01dfn:\n'))
@example(value='"\\Uffffffff"')
@example(value='"\\U00110000"')
@examples(80)
def test_what_a_person_writes_as_a_trailer_can_be_read(value: str) -> None:
    parse(f"x\n\nNote: {value}\n")


@given(trailers=TRAILERS)
@example(trailers=[("Requester", value) for value in HOSTILE])
@examples(20)
def test_git_keeps_the_message_whole_and_finds_the_same_trailers(
    repo: pygit2.Repository, trailers: list[tuple[str, str]]
) -> None:
    text = compose([["Join a"]], [*trailers, ("Render-Version", "2")])
    who = pygit2.Signature("x", "x@example.org", 0, 0)
    commit = repo.create_commit(None, who, who, text, repo.TreeBuilder().write(), [])
    assert repo[commit].peel(pygit2.Commit).message == text
    by_git = git(
        repo.path, "log", "-1", "--encoding=UTF-8", "--format=%(trailers:only)", str(commit)
    )
    assert parse(f"Join a\n\n{by_git}") == parse(text)


def test_messages_of_earlier_versions_are_read_as_they_were_meant() -> None:
    values = ['"', "\\", '"a"', "a: b", "a\u200bb", '"\\\'"', "a\\x41"]
    text = "Join a\n\n" + "".join(f"Requester: {value}\n" for value in values)
    assert parse(text).trailers["Requester"] == values
