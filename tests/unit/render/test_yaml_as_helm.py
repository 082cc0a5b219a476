"""Scalars are read as Helm reads them, and written so that each parser reads them back.

``helm-reads.txt`` has what Helm 4.2 made of ``list: [FORM]`` in a values file, as JSON (`toJson`).
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from demandops.base import strict_yaml
from demandops.base.errors import InvalidInput
from demandops.decide.warnings import truth_warnings
from hypothesis import given
from hypothesis import strategies as st

from tests.kit.chance import examples

TABLE = Path(__file__).with_name("helm-reads.txt").read_text().splitlines()
HELM_READS = dict(line.split(None, 1) for line in TABLE)


@pytest.mark.parametrize(("form", "by_helm"), HELM_READS.items())
def test_a_scalar_means_what_it_means_to_helm(form: str, by_helm: str) -> None:
    if by_helm == "refused":
        with pytest.raises(InvalidInput, match="no number to Helm or JSON"):
            strict_yaml.load(f"a: {form}")
        return
    value, wanted = strict_yaml.load(f"a: {form}")["a"], json.loads(by_helm)
    if type(wanted) in (int, float):  # Helm has no whole numbers
        assert type(value) in (int, float) and float(value) == float(wanted)
    else:
        assert value == wanted and type(value) is type(wanted)
    for written in (strict_yaml.dump({"a": form}), strict_yaml.dump({form: "a"})):
        assert wanted == form or f'"{form}"' in written


def test_check_warns_of_words_that_may_be_meant_as_text() -> None:
    text = "a: NO # N\n# {x, y}\nb: [on, x]\n- y\nc: no one\ny: 1\ne: {f: Off}\nyes\ng: nO\n"
    paths = (
        "overrides/a.yaml",
        "appdefs/a/values/a.yaml.j2",
        "appdefs/a/charts/a/values.yaml",
        "ledger/a.yaml",
    )
    told = [*truth_warnings(dict.fromkeys(paths, text))]
    assert [one.line for one in told] == [1, 3, 4, 7, 8] * 2
    assert {one.file for one in told} == {*paths[:2]}
    assert "NO is false, as" in told[0].message


def test_a_key_is_text_or_a_fault() -> None:
    assert strict_yaml.load("{x: 1, y: 2, n: 3, 'on': 4}") == {"x": 1, "y": 2, "n": 3, "on": 4}
    for key in ("on", "No", "8080", "1e3", "~", "[a]", "0x1f", "<<"):
        with pytest.raises(InvalidInput, match=r"put it in quotes|write the fields"):
            strict_yaml.load(f"? {key}\n: 1")


NUMBERS = st.integers() | st.floats(allow_nan=False, allow_infinity=False)
WORDS = [
    *HELM_READS,
    "/v1/points", "yes", "1", "a b", "", "é", "it's", "a: b", "# c", 'a"b', "a\\b", "\x7f", "~",
]  # fmt: skip
STAND_INS = ["!demandops-list", "x\n- !demandops-list\ny\n"]
LONG = ["x" * 90, "x" * 120, "a b" * 40, "x " * 2500, "x" * 5000]
TOPICS = st.integers(0, 40).map(lambda count: [f"/vehicle{one:02}/points" for one in range(count)])
LISTS = TOPICS | st.lists(st.sampled_from([*WORDS, *STAND_INS, "/v1/points"]), max_size=12)
DATA = st.recursive(
    LISTS | st.sampled_from([*WORDS, *STAND_INS, *LONG]) | st.none() | NUMBERS,
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from(["a", "b", *WORDS, *STAND_INS, *LONG]), inner, max_size=3)
    ),
    max_leaves=6,
)
AROUND = [
    "{}", "x: |\n  {}", "x: '{}'", "x: {{{}}}", "- {}", "{} # why", "{}\n  more", "? {}",
    "{}\n  - more", "!!str {}", "{}\n---\nb: 1", "{}\nb: [", "{}\nb: *a",
]  # fmt: skip


def outcome(read: Any) -> tuple[str, Any]:
    try:
        return "read", read()
    except InvalidInput as error:
        return "refused", str(error)


def assert_read_as_by_pyyaml(text: str) -> None:
    def by_pyyaml() -> Any:
        (document,) = strict_yaml.load_all(text, most=1)
        return document

    assert outcome(lambda: strict_yaml.load(text)) == outcome(by_pyyaml)


@given(data=DATA)
@examples(100)
def test_what_is_written_is_read_back(data: Any) -> None:
    written = strict_yaml.dump({"data": data})
    value = strict_yaml.load(written)
    assert repr(value) == repr({"data": data})
    assert strict_yaml.dump(value) == written
    assert repr(strict_yaml.load(f"data: {strict_yaml.to_json(data)}")) == repr(value)


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
