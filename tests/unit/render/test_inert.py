"""Every YAML parser reads any id, selector or toleration back as the text that it was.

PyYAML reads YAML 1.1, and ``Core`` below reads the core schema of YAML 1.2. Go's parsers read a
mixture of both, so a scalar without quotes must be text in both.
"""

from __future__ import annotations

import json
import re
import tracemalloc
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from demandops.base import strict_yaml
from demandops.base.errors import InvalidInput
from demandops.base.naming import control_character, one_form
from demandops.decide.warnings import truth_warnings
from demandops.model.config.load import load
from hypothesis import given
from hypothesis import strategies as st

from tests.kit import plain_yaml
from tests.kit.chance import examples
from tests.kit.config import configuration, override, skeleton
from tests.kit.goals import application, connection, goal
from tests.kit.memory import MemoryRepo
from tests.kit.plain_yaml import FAST

NODES = "inventory/nodes.yaml"

_TEXTS = plain_yaml.beside(__file__)
TRAPS, UNSEEN, LABELS = (_TEXTS[name] for name in ("traps", "unseen", "labels"))
# a node's id has no star
IDS = [t for t in (*TRAPS, "x", "x-watcher") if one_form(t) == t and "*" not in t]


class Core(FAST):  # type: ignore[misc]
    """Reads YAML by the core schema of YAML 1.2.2 (section 10.3.2)."""


Core.yaml_implicit_resolvers = {}
for tag, pattern in (
    ("null", r"null|Null|NULL|~|"),
    ("bool", r"true|True|TRUE|false|False|FALSE"),
    ("int", r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+"),
    ("float", r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?"),
    ("float", r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)"),
):
    Core.add_implicit_resolver(f"tag:yaml.org,2002:{tag}", re.compile(rf"(?:{pattern})\Z"), None)
Core.add_constructor(
    "tag:yaml.org,2002:int", lambda loader, node: int(loader.construct_scalar(node), 0)
)

SURELY_TEXT = re.compile(r"[A-Za-z_/.-][A-Za-z0-9 _/.:@=()+,'-]*|[0-9]+(m|Mi|Gi)")
SOMEWHERE_NO_TEXT = re.compile(
    r"~|<<|=|null|y|n|yes|no|on|off|true|false|[-+]?\.(inf|nan)|nan|inf|infinity", re.IGNORECASE
)


def both(text: str) -> list[Any]:
    """Return the documents in a text, after a check that YAML 1.1 and 1.2 read them alike."""
    old = list(yaml.load_all(text, Loader=FAST))
    new = list(yaml.load_all(text, Loader=Core))
    assert old == new
    return old


def plain_texts(text: str) -> Iterator[str]:
    """Yield every scalar without quotes that PyYAML takes for text."""
    resolver = yaml.resolver.Resolver()  # type: ignore[no-untyped-call]
    for event in yaml.parse(text, Loader=FAST):
        if isinstance(event, yaml.ScalarEvent) and event.style in (None, "") and event.implicit[0]:
            tag = resolver.resolve(yaml.ScalarNode, event.value, (True, False))
            if tag == "tag:yaml.org,2002:str":
                yield event.value


def assert_unmistakable(text: str) -> None:
    both(text)
    for value in plain_texts(text):
        assert SURELY_TEXT.fullmatch(value), repr(value)
        assert not SOMEWHERE_NO_TEXT.fullmatch(value), repr(value)


def quoted(text: str) -> str:
    """Return a text as a YAML scalar in quotes, with each character written as an escape."""
    return '"' + "".join(f"\\U{ord(char):08X}" for char in text) + '"'


def inventory(lines: Iterable[str]) -> MemoryRepo:
    """Return a state repo with one more vehicle for each item of ``lines``.

    An item is the vehicle's YAML without the fields ``type`` and ``cluster``.
    """
    entries = "".join(f"  - type: vehicle\n    cluster: c-its\n{line}" for line in lines)
    return MemoryRepo({NODES: skeleton()[NODES] + entries})


def test_ids_are_read_back_as_they_were() -> None:
    books = inventory(f"    id: {quoted(text)}\n    selector: {{a: b}}\n" for text in IDS)
    for text in IDS:
        app = application(text, who=[text], clouds=[("/a", text)])
        link = connection(text, who=[text], ends=(text, "edge"), topics=["/a"])
        books.send(goal([app], [link], id=text))
    claimed = []
    for content in books.below("ledger").values():
        assert_unmistakable(content)
        (claim,) = both(content)
        (text,) = {
            claim["request"],
            *claim["requesters"],
            (claim.get("application") or claim["connection"])["id"],
        }
        claimed.append(text)
    assert sorted(claimed) == sorted(IDS * 2)
    for content in books.rendered().values():
        assert_unmistakable(content)
    texts = "".join(books.rendered().values())
    names = re.findall(r"nodeName: (\S+)", texts)
    assert len({*names}) == len(names), "a service and a watcher have one name"
    ends = [item["metadata"]["annotations"] for item in books.objects("Deployment").values()]
    assert sorted(end["demandops/connection"] for end in ends) == sorted(IDS * 2)
    for end in ends:
        nodes = {end["demandops/node"], end["demandops/peer"]}
        assert nodes == {end["demandops/connection"], "edge"}
    notes = [item["metadata"]["annotations"] for item in books.objects("HelmRelease").values()]
    named = [note.get("demandops/application", note.get("demandops/source")) for note in notes]
    assert sorted(named) == sorted(IDS * 2)


ANY_TEXT = [
    text for text in (*TRAPS, *UNSEEN) if not control_character(re.sub(r"[\n\t]", " ", text))
]
"""Texts that the configuration accepts. It refuses the rest of ``TRAPS`` and ``UNSEEN``."""


def test_what_people_write_of_a_node_is_read_back_as_it_was() -> None:
    """A toleration may have any text; a selector may even have a text like ``yes`` or ``010``."""
    tolerations = [{"key": text, "value": text} for text in ANY_TEXT]
    selector = {label: label for label in LABELS} | {"a": ""}
    texts = ", ".join(f"{{key: {quoted(text)}, value: {quoted(text)}}}" for text in ANY_TEXT)
    labels = ", ".join(f'"{label}": "{text}"' for label, text in selector.items())
    books = inventory([f'    id: "n"\n    tolerations: [{texts}]\n    selector: {{{labels}}}\n'])
    books.send(goal([application(node="n")], [connection(ends=("n", "edge"))]))
    for content in books.rendered().values():
        both(content)
    values = [release["spec"]["values"] for release in books.objects("HelmRelease").values()]
    (pod,) = (
        deployment["spec"]["template"]["spec"]
        for deployment in books.objects("Deployment").values()
        if deployment["metadata"]["annotations"]["demandops/node"] == "n"
    )
    for found in (*values, pod):
        assert found["tolerations"] == tolerations
        assert found["nodeSelector"] == selector


@pytest.mark.parametrize("text", [*TRAPS, *UNSEEN, ""])
def test_a_written_text_is_read_back_by_every_parser(text: str) -> None:
    for data in ({"a": text}, {text or "x": "a"}, {"a": [text, {"b": text}]}, {"a": text, "b": 1}):
        written = strict_yaml.dump(data)
        assert both(written) == [data], written
        assert yaml.safe_load(written) == data
        assert strict_yaml.load(written) == data
        assert both(f"a: {strict_yaml.to_json(text)}\n") == [{"a": text}]


@pytest.mark.parametrize("number", [float("inf"), float("-inf"), float("nan")])
def test_a_number_that_json_lacks_is_not_written_as_text(number: float) -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        strict_yaml.to_json({"a": [number]})


@pytest.mark.parametrize(
    "value",
    ["!!binary aGk=", "!!set {x}", "!!omap [x: 1]", "!!int x", ".inf"],
    ids=lambda value: value[:10],
)
def test_what_json_or_a_program_cannot_hold_is_a_fault_of_its_file(value: str) -> None:
    text = override({"nodes": ["*"]}, hold=True) + f"values: {{a: {value}}}\n"
    with pytest.raises(InvalidInput) as invalid:
        load(configuration({"overrides/odd.yaml": text}))
    assert {found.file for found in invalid.value.faults} == {"overrides/odd.yaml"}
    assert "not valid YAML" in str(invalid.value)


def test_a_file_that_is_too_long_is_not_parsed() -> None:
    text = "a: [" + "x, " * (strict_yaml.MAX_LENGTH // 3) + "]"
    with pytest.raises(InvalidInput, match="at most 4000000 are allowed"):
        strict_yaml.load(text)


def test_long_texts_are_not_kept_in_memory() -> None:
    tracemalloc.start()
    try:
        for number in range(100):
            text = f"{number:03}" + "a" * 100_000
            assert strict_yaml.load(strict_yaml.dump({"text": text})) == {"text": text}
            assert strict_yaml.load(f"text: {text}") == {"text": text}
        assert tracemalloc.get_traced_memory()[0] < 2_000_000
    finally:
        tracemalloc.stop()


# ---- scalars are read as Helm reads them, and written so that each parser reads them back ----


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


@pytest.mark.parametrize("char", ["x", "\x7f"])
def test_a_key_is_too_long_if_it_could_not_be_written_in_json(char: str) -> None:
    longest = char * ((1024 - 2) // len(strict_yaml.to_json(char)[1:-1]))
    assert strict_yaml.load(f"a: {strict_yaml.to_json({longest: 1})}") == {"a": {longest: 1}}
    with pytest.raises(InvalidInput, match="a key has more than 1024 characters; shorten it"):
        strict_yaml.load(strict_yaml.dump({longest + char: 1}))


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
        | st.dictionaries(
            st.sampled_from(["a", "b", *WORDS, *STAND_INS, *LONG[:3]]), inner, max_size=3
        )
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
