"""Different ids give different names, and Kubernetes and ROS 2 accept every name."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import combinations

from demandops.base import naming
from demandops.base.naming import id_problem
from demandops.model.ledger.claim import demand_id
from hypothesis import given
from hypothesis import strategies as st

from tests.kit.chance import examples, visible

DNS_1123 = re.compile(r"[a-z0-9]([-a-z0-9]*[a-z0-9])?")
ROS_NODE = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
LONGEST_NAME = 53

Subject = tuple[str, ...]
"""What a name is made from: a prefix, and ids or topics."""
COUNTS = {"od": (2, 3), "of": (1,), "mqtt": (2,)}
"""How many ids the program puts behind a prefix."""

close = st.text("ab0-_/.A", min_size=1, max_size=5)
hashed = st.builds(
    "{}{}{}".format,
    st.sampled_from(["", "a", "edge", "edge/a"]),
    st.sampled_from(["-", "_", "/", ""]),
    st.text("0123456789abcdef", min_size=12, max_size=12),
)
long = st.builds(
    lambda filler, size, end: filler * (size // len(filler)) + end,
    st.sampled_from(["a", "ab-", "a/", "x_", "ü"]),
    st.sampled_from([54, 300, 1000]),
    st.sampled_from(["", "a", "b", "-", "_a"]),
)
anything = st.text(visible, min_size=1, max_size=12)
ids = st.one_of(close, hashed, long, anything).filter(lambda text: not id_problem(text))
subjects: st.SearchStrategy[Subject] = st.one_of(
    st.tuples(st.just(prefix), *[ids] * count)
    for prefix, counts in COUNTS.items()
    for count in counts
)


def rivals(subject: Subject, name: str) -> Iterator[Subject]:
    """Yield other subjects that would also get ``name`` if names were made in a simpler way."""
    prefix, *ids_ = subject
    rest = name.removeprefix(f"{prefix}-")
    pieces = rest.split("-")
    yield ("of", rest)
    for cut in range(1, len(pieces)):
        yield (prefix, "-".join(pieces[:cut]), "-".join(pieces[cut:]))
    for old, new in (("_", "-"), ("/", "-"), ("-", "_"), ("/", "_")):
        yield (prefix, *(part.replace(old, new) for part in ids_))
        yield (prefix, *(part.replace(old, new) for part in pieces))
    for first in (ids_[0].lower(), ids_[0].upper(), ids_[0][:-1] or "x"):
        yield (prefix, first, *ids_[1:])


@examples(40)
@given(st.lists(subjects, min_size=1, max_size=12))
def test_different_subjects_have_different_names_that_kubernetes_takes(
    drawn: list[Subject],
) -> None:
    found = set(drawn)
    for _ in range(2):  # the second round adds the rivals of rivals
        every = [one for each in found for one in rivals(each, naming.object_name(*each))]
        found |= {one for one in every if len(one) - 1 in COUNTS[one[0]]}
        if len(found) > 150:
            break
    names: dict[str, Subject] = {}
    for subject in sorted(found):
        name = naming.object_name(*subject)
        assert names.setdefault(name, subject) == subject, "two subjects have one name"
        assert DNS_1123.fullmatch(name) and len(name) <= LONGEST_NAME, subject
    ros_names = {naming.ros_name(name) for name in names}
    assert len(ros_names) == len(names)
    assert all(ROS_NODE.fullmatch(name) for name in ros_names)


def test_each_group_of_requesters_has_a_demand_of_its_own() -> None:
    pairs = [*combinations(["a", "a,b", "b", "a b", '["a"]', "a\\", "\\a", '"'], 2)]
    assert len({demand_id("request", pair) for pair in pairs}) == len(pairs)
