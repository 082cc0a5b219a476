"""Text stays text: whatever an id, a selector or a toleration holds, every parser reads it back.

PyYAML reads YAML 1.1, ``Core`` below the core schema of YAML 1.2; Go's parsers read a mixture, so
``plain`` scalars must be text in all of them.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from typing import Any

import pytest
import yaml
from demandops import strict_yaml
from demandops.identifiers import control_character

from tests.kit.config import FAST, skeleton
from tests.kit.goals import application, connection, goal
from tests.kit.memory import MemoryRepo

NODES = "inventory/nodes.yaml"

TRAPS = [
    "yes", "no", "on", "off", "y", "n", "Y", "N", "true", "True", "TRUE", "null", "Null", "NULL",
    "~", "1e3", "1E3", "1e-3", "0o7", "0O7", "010", "0x1F", "0b11", "12:30:45", "1:20", "190:20:30",
    "1_000", "1.", ".5", "1.5e3", "+1", "-1", ".inf", "-.INF", ".nan", ".NaN", "nan", "inf",
    "2026-01-31", "2026-01-31T12:00:00Z", "<<", "=", "-", "?", ":", "- a", "? a", "a: b", "a #b",
    "#a", "&a", "*a", "!a", "%a", "@a", "`a", "|", ">", "[a", "]a", "{a", "}a", ",a", "'", '"',
    "'a'", '"a"', "---", "--- a", "\\", "\\n", "{{ a }}", "{% a %}", "{# a #}", "${a}", "$(a)",
    "é", "车辆", "🚗", "a\u00a0b", "a\u200bb", "\u00ad", "a\ufeffb", "\ufffd",
]  # fmt: skip

UNSEEN = [
    "...", "\u2028", "\u2029", "\u0085", "\x7f", "\x0b", "\x0c", "\x1c", "\x1e", "\b", "\0",
    "\t", "\r", "\n", "\r\n", "a\u2028b\n", "a\nb\n", "a\n\nb\n", " a\n b\n", "a \n", "\na",
    "a\n\n", "\ufeff", "\ufffe", "\uffff", "\x9f", "\U0010ffff",
]  # fmt: skip


class Core(FAST):  # type: ignore[misc]
    """The core schema of YAML 1.2.2, section 10.3.2."""


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
    """Return the documents of a text as YAML 1.1 and 1.2 read them, which must be alike."""
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
    """Return a text as YAML that holds nothing but ASCII letters, whatever the text holds."""
    return '"' + "".join(f"\\U{ord(char):08X}" for char in text) + '"'


def inventory(lines: Iterable[str]) -> MemoryRepo:
    """Return a state repo with further nodes, each given by what stands below its kind."""
    entries = "".join(f"  - type: vehicle\n    cluster: c-its\n{line}" for line in lines)
    return MemoryRepo({NODES: skeleton()[NODES] + entries})


@pytest.fixture(scope="module")
def odd_nodes() -> MemoryRepo:
    """Return a state repo in which each trap is a node's id."""
    return inventory(f"    id: {quoted(text)}\n    selector: {{a: b}}\n" for text in TRAPS)


@pytest.mark.parametrize("text", TRAPS)
def test_an_id_is_read_back_as_it_was(odd_nodes: MemoryRepo, text: str) -> None:
    books = odd_nodes.copy()
    books.send(
        goal(
            [application(text, who=[text], clouds=[("/a", text)])],
            [connection(text, who=[text], ends=(text, "edge"))],
            id=text,
        )
    )
    for path, content in books.files.items():
        if path.startswith("ledger/") and path.endswith(".yaml"):
            assert_unmistakable(content)
            (claim,) = both(content)
            assert claim["request"] == text
            assert claim["requesters"] == [text]
            assert text in (claim.get("application"), claim.get("connection"))
    for content in books.rendered().values():
        assert_unmistakable(content)
    for deployment in books.objects("Deployment").values():
        notes = deployment["metadata"]["annotations"]
        assert notes["demandops/connection"] == text
        assert {notes["demandops/node"], notes["demandops/peer"]} == {text, "edge"}
    notes = [item["metadata"]["annotations"] for item in books.objects("HelmRelease").values()]
    assert {note.get("demandops/application", note.get("demandops/source")) for note in notes} == {
        text
    }


def there(books: MemoryRepo, node: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the values of a release and the pod of a connection's end that run on a node."""
    books.send(goal([application(node=node)], [connection(ends=(node, "edge"))]))
    for content in books.rendered().values():
        both(content)
    values = [release["spec"]["values"] for release in books.objects("HelmRelease").values()]
    (pod,) = (
        deployment["spec"]["template"]["spec"]
        for deployment in books.objects("Deployment").values()
        if deployment["metadata"]["annotations"]["demandops/node"] == node
    )
    return values[0], pod


ANY_TEXT = [
    text for text in (*TRAPS, *UNSEEN) if not control_character(re.sub(r"[\n\t]", " ", text))
]
"""Whatever the configuration accepts; tests/unit/config holds that it refuses the others."""


@pytest.fixture(scope="module")
def tainted_nodes() -> MemoryRepo:
    """Return a state repo in which each text is a toleration of the node ``n<its index>``."""
    return inventory(
        f"    id: n{index}\n    tolerations: [{{key: {quoted(text)}, value: {quoted(text)}}}]\n"
        for index, text in enumerate(ANY_TEXT)
    )


@pytest.mark.parametrize("index", range(len(ANY_TEXT)), ids=[repr(text) for text in ANY_TEXT])
def test_a_toleration_is_read_back_as_it_was(tainted_nodes: MemoryRepo, index: int) -> None:
    """People write them, in any text that YAML can hold."""
    values, pod = there(tainted_nodes.copy(), f"n{index}")
    wanted = [{"key": ANY_TEXT[index], "value": ANY_TEXT[index]}]
    assert (values["tolerations"], pod["tolerations"]) == (wanted, wanted)


LABELS = ["yes", "y", "1e3", "0x1F", "010", "1_000", "2026-01-31", "null", "true", "12", "1.5", ""]


@pytest.fixture(scope="module")
def labelled_nodes() -> MemoryRepo:
    """Return a state repo in which each label selects the node ``n<its index>``."""
    return inventory(
        f'    id: n{index}\n    selector: {{"{label or "a"}": "{label}"}}\n'
        for index, label in enumerate(LABELS)
    )


@pytest.mark.parametrize("index", range(len(LABELS)), ids=[repr(label) for label in LABELS])
def test_a_selector_is_text_for_every_parser(labelled_nodes: MemoryRepo, index: int) -> None:
    books = labelled_nodes.copy()
    values, pod = there(books, f"n{index}")
    wanted = {LABELS[index] or "a": LABELS[index]}
    assert (values["nodeSelector"], pod["nodeSelector"]) == (wanted, wanted)
    for content in books.rendered().values():
        assert_unmistakable(content)


@pytest.mark.parametrize("name", ["null", "y", "1e3", "12", "0x1f", "010", "true", "on"])
def test_names_that_kubernetes_takes_and_yaml_misreads(name: str) -> None:
    """A namespace, an account, a secret and a cluster may be called so."""
    domains = (
        "apiVersion: demandops/v1\nkind: AccessDomains\ndomains:\n"
        f'  - {{name: "{name}", namespace: "{name}", serviceAccount: "{name}", nodes: ["*"]}}\n'
    )
    clusters = f'apiVersion: demandops/v1\nkind: Clusters\nclusters: [{{name: "{name}"}}]\n'
    nodes = skeleton()[NODES].replace("cluster: c-its", f'cluster: "{name}"')
    nodes = nodes.replace("- id: edge\n", f'- id: edge\n    imagePullSecrets: ["{name}"]\n')
    books = MemoryRepo(
        {"policy/access-domains.yaml": domains, "inventory/clusters.yaml": clusters, NODES: nodes}
    )
    books.send(goal([application()], [connection()]))
    seen = 0
    for path, content in books.rendered().items():
        if path.startswith(f"clusters/{name}/{name}/"):
            seen += 1
            assert_unmistakable(content)
            for document in both(content):
                assert document["metadata"]["namespace"] == name
                assert (
                    document["spec"].get("serviceAccountName", name) == name
                    if "spec" in document
                    else True
                )
    assert seen == 4
    for release in books.objects("HelmRelease").values():
        assert release["spec"]["values"]["imagePullSecrets"] == [{"name": name}]


@pytest.mark.parametrize("text", [*TRAPS, *UNSEEN, ""])
def test_a_written_text_is_read_back_by_every_parser(text: str) -> None:
    for data in ({"a": text}, {text or "x": "a"}, {"a": [text, {"b": text}]}, {"a": text, "b": 1}):
        written = strict_yaml.dump(data)
        assert both(written) == [data], written
        assert yaml.safe_load(written) == data
        assert strict_yaml.load(written) == data
        assert both(f"a: {strict_yaml.to_json(text)}\n") == [{"a": text}]


def test_numbers_and_truths_stay_numbers_and_truths() -> None:
    data = {"a": [1, -1, 0, 1.5, 1e30, 10**20, True, False, None]}
    written = strict_yaml.dump(data)
    assert both(written) == [data], written


@pytest.mark.parametrize("text", [text for text in UNSEEN if ord(text[0]) < 0xFEFF])
def test_what_no_reader_would_see_is_refused_in_an_id(text: str) -> None:
    assert MemoryRepo().faults(goal([], [connection(f"a{text.strip('ab ')}b")]))
