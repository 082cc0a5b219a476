"""``strict_yaml`` writes simple values and reads long lists as PyYAML does, but without PyYAML."""

from __future__ import annotations

from typing import Any

import pytest
from demandops.base import strict_yaml
from demandops.base.errors import InvalidInput
from hypothesis import given
from hypothesis import strategies as st

from tests.kit.chance import examples

WORDS = [
    "/v1/points", "yes", "1", "a b", "", "é", "it's", "a: b", "# c", 'a"b', "a\\b", "\x7f", "~",
]  # fmt: skip
STAND_INS = ["demandops-list", "demandops-list-0", "- demandops-list", "x\n- demandops-list\ny\n"]
LONG = ["x" * 90, "x" * 120, "a b" * 40, "x " * 2500, "x" * 5000]
TOPICS = st.integers(0, 40).map(lambda count: [f"/vehicle{one:02}/points" for one in range(count)])
LISTS = TOPICS | st.lists(st.sampled_from([*WORDS, *STAND_INS, "/v1/points"]), max_size=12)
DATA = st.recursive(
    LISTS | st.sampled_from([*WORDS, *STAND_INS, *LONG]) | st.none() | st.integers() | st.floats(),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from(["a", "b", *WORDS, *STAND_INS, *LONG]), inner, max_size=3)
    ),
    max_leaves=6,
)
AROUND = [
    "{}", "x: |\n  {}", "x: '{}'", "x: {{{}}}", "- {}", "{} # why", "{}\n  more", "? {}",
    "!!str {}",
]  # fmt: skip


def outcome(read: Any) -> tuple[str, Any]:
    try:
        return "read", read()
    except InvalidInput as error:
        return "refused", str(error)


def assert_read_as_by_pyyaml(text: str) -> None:
    by_pyyaml = outcome(lambda: next(strict_yaml.load_all(text, most=1)))
    assert outcome(lambda: strict_yaml.load(text)) == by_pyyaml


@given(data=DATA)
@examples(100)
def test_pyyaml_would_write_the_same(data: Any) -> None:
    written = strict_yaml.dump({"data": data})
    assert written + 'odd: "\\x01"\n' == strict_yaml.dump({"data": data, "odd": "\x01"})
    assert repr(strict_yaml.load(written)) == repr({"data": data})


@given(values=st.lists(LISTS, min_size=1, max_size=3), around=st.sampled_from(AROUND))
@examples(100)
def test_a_list_is_read_as_pyyaml_reads_it(values: list[list[str]], around: str) -> None:
    fields = [f"f{place}: {strict_yaml.to_json(value)}" for place, value in enumerate(values)]
    indent = "\n" + " " * (len(around.partition("{}")[0].rpartition("\n")[2]))
    assert_read_as_by_pyyaml(around.format(indent.join(fields)))


@pytest.mark.parametrize("depth", [98, 99, 100])
def test_a_list_counts_as_a_level(depth: int) -> None:
    opened = "".join(f"{' ' * level}a:\n" for level in range(depth))
    assert_read_as_by_pyyaml(
        f"{opened}{' ' * depth}b: {strict_yaml.to_json(['/v1/points'] * 40)}\n"
    )


def test_long_texts_stay_refused() -> None:
    text = f"a: {strict_yaml.to_json(['/v1/points'] * 40)}\n" + "#" * strict_yaml.MAX_LENGTH
    with pytest.raises(InvalidInput, match="characters; at most"):
        strict_yaml.load(text)
