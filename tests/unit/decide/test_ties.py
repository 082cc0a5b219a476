"""A configuration is valid only if no result depends on the order of overrides of equal priority.

The tests compare random selectors with every possible release.
"""

from __future__ import annotations

from functools import lru_cache, partial
from itertools import product
from json import dumps
from typing import Any

import pytest
from demandops.decide.changeset import trial_releases
from demandops.decide.planning.overrides import Traits, apply_effects, effects_on, fits
from demandops.model.config.cross_check import patterns_overlap
from demandops.model.config.override import Override, OverrideFile, Selector
from demandops.model.config.policy import matches
from demandops.model.release import ServiceRelease
from demandops.templating.charts import merged, overridden
from hypothesis import example, given
from hypothesis import strategies as st

from tests.kit import plain_yaml
from tests.kit.chance import examples
from tests.kit.config import contested_effects, may_select_same_release, patches_commute
from tests.kit.memory import MemoryRepo

TEXTS = ["".join(chars) for size in range(7) for chars in product("ab", repeat=size)]
pattern = st.text("ab*?", min_size=1, max_size=4)


@given(pattern, pattern)
@example("a*b", "*")
@example("*a*", "b?b*")
@example("?", "ab")
def test_patterns_overlap_just_where_some_text_fits_both(one: str, other: str) -> None:
    both = any(matches(text, (one,)) and matches(text, (other,)) for text in TEXTS)
    assert patterns_overlap(one, other) is both
    assert patterns_overlap(other, one) is both


CONFIG = MemoryRepo().config
IDS = ["a", "b", "ab"]
SOME = [("a",), ("b",), ("a", "b")]
NODES = ["edge", "cloud"]
SHARED, OWN, APPDEF = "object-detection", "object-fusion", "object-detection-fusion"


def _releases() -> list[Traits]:
    """Return the traits of every possible release in a world with few names."""
    found = []
    for node, who in product(NODES, SOME):
        found += [Traits((node,), who, (id,), (APPDEF,), service=OWN) for id in IDS]
        found += [Traits((node,), who, ids, (APPDEF,), service=SHARED) for ids in SOME]
        found += [Traits((node,), who, connections=(id,)) for id in IDS]
    return found


RELEASES = _releases()
patterns = st.lists(st.sampled_from(["a", "b", "a*", "*b", "?", "*"]), min_size=1, max_size=2)
fields = st.fixed_dictionaries(
    {},
    optional={
        "applications": patterns,
        "appdefs": st.lists(st.sampled_from([APPDEF, "other", "*"]), min_size=1, max_size=1),
        "services": st.lists(st.sampled_from([SHARED, OWN, "object-*"]), min_size=1, max_size=1),
        "nodes": st.lists(st.sampled_from(["edge", "cloud", "e*", "*"]), min_size=1, max_size=2),
        "requesters": patterns,
        "labels": st.sampled_from([{"node_id": "edge"}, {"node_id": "cloud"}, {"other": "x"}]),
    },
) | st.fixed_dictionaries(
    {"connections": patterns},
    optional={"nodes": st.just(["edge"]), "requesters": patterns},
)
selector = fields.filter(bool).map(Selector.model_validate)


@given(st.lists(selector, min_size=1, max_size=2), st.lists(selector, min_size=1, max_size=2))
@examples(60)
def test_selectors_that_cannot_meet_never_do(one: list[Selector], other: list[Selector]) -> None:
    if may_select_same_release(one, other, CONFIG):
        return
    assert not may_select_same_release(other, one, CONFIG)
    for traits in RELEASES:
        hit = [any(fits(s, traits, CONFIG) for s in side) for side in (one, other)]
        assert not all(hit), traits


@pytest.mark.parametrize(
    ("pair", "meet"),
    [
        (pair, name == "together")
        for name, pairs in plain_yaml.beside(__file__).items()
        for pair in pairs
    ],
    ids=str,
)
def test_selectors_that_differ_in_a_single_valued_trait_never_meet(
    pair: list[dict[str, Any]], meet: bool
) -> None:
    one, other = (Selector.model_validate(fields) for fields in pair)
    assert may_select_same_release([one], [other], CONFIG) is meet


json = st.recursive(
    st.none() | st.booleans() | st.integers(0, 2) | st.sampled_from("xy"),
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(st.sampled_from("kl"), inner),
    max_leaves=4,
)
_text = partial(dumps, sort_keys=True)
patch = st.fixed_dictionaries({}, optional={"k": json, "l": json})


# what a chart has below the values: nothing, some defaults, or it is not known
below = st.none() | patch


@given(patch, patch, patch, below)
@examples(60)
def test_patches_that_commute_give_the_same_in_either_order(
    target: dict[str, Any], one: dict[str, Any], other: dict[str, Any], below: dict[str, Any] | None
) -> None:
    both = (
        overridden(overridden(target, one, below), other, below),
        overridden(overridden(target, other, below), one, below),
    )
    if patches_commute(one, other):
        assert _text(both[0]) == _text(both[1])


@given(json, patch)
def test_a_merge_patch_is_that_of_rfc_7386(target: Any, patch: Any) -> None:
    result = overridden(target, patch, {})
    kept = target if isinstance(target, dict) else {}
    for key in {*kept, *patch}:
        if key not in patch:
            assert result[key] == kept[key]
        elif patch[key] is None:
            assert key not in result
        elif isinstance(patch[key], dict):
            assert result[key] == overridden(kept.get(key), patch[key], {})
        else:
            assert result[key] == patch[key]


DEFAULTS = {"limits": {"cpu": 1, "memory": 2}, "env": {}}


@pytest.mark.parametrize(
    ("values", "patches", "result", "in_helm"),
    [
        ({}, [{"limits": None}], {"limits": None}, {"env": {}}),
        ({"limits": {"cpu": 3}}, [{"limits": None}], {"limits": None}, {"env": {}}),
        ({}, [{"limits": {"cpu": None}}], {"limits": {"cpu": None}}, {"limits": {"memory": 2}}),
        # a null that no default meets would reach the chart's templates, and fail its schema
        (
            {"env": {"A": "1", "B": "2"}, "x": 1},
            [{"env": {"A": None}, "x": None}],
            {"env": {"B": "2"}},
            None,
        ),
        ({}, [{"limits": None}, {"limits": {"gpu": 1}}], None, {"limits": {"gpu": 1}, "env": {}}),
        ({}, [{"limits": {"gpu": 1}}, {"limits": None}], {"limits": None}, {"env": {}}),
        ({}, [{"limits": None}, {"limits": {"cpu": 4}}], None, {"limits": {"cpu": 4}, "env": {}}),
        ({}, [{"env": {"A": "1"}}, {"env": {"A": None}}], {"env": {}}, DEFAULTS),
    ],
)
def test_null_removes_what_the_template_wrote_and_what_the_chart_has(
    values: dict[str, Any], patches: list[dict[str, Any]], result: Any, in_helm: Any
) -> None:
    for each in patches:
        values = overridden(values, each, DEFAULTS)
    assert result is None or values == result
    coalesced = merged(DEFAULTS, values)
    assert in_helm is None or coalesced == {"env": {}} | in_helm
    assert None not in (*coalesced.values(), *coalesced.get("limits", {}).values())


pins = st.sampled_from([{"tag": "x"}, {"tag": "y"}, {"repository": "z"}])
effects = st.fixed_dictionaries(
    {},
    optional={
        "values": st.fixed_dictionaries({"k": json}, optional={"l": json}),
        "replicas": st.integers(1, 2),
        "node": st.sampled_from(["edge", "cloud"]),
        "images": st.fixed_dictionaries(
            {}, optional={"object-detection": pins, "object-fusion": pins}
        ).filter(bool),
    },
).filter(bool) | st.just({"hold": True})


@lru_cache
def _release() -> ServiceRelease:
    (made,) = trial_releases(CONFIG).values()
    return made[0]


@given(effects, effects)
@examples(60)
def test_uncontested_overrides_give_the_same_result_in_either_order(
    one: dict[str, Any], other: dict[str, Any]
) -> None:
    both = [_override(name, fields) for name, fields in (("one", one), ("other", other))]
    if contested_effects(*both):
        assert contested_effects(both[1], both[0])
        return
    first, second = (_shaped(order) for order in (both, both[::-1]))
    assert first == second


def _override(name: str, fields: dict[str, Any]) -> Override:
    head = {"apiVersion": "demandops/v1", "kind": "Override", "reason": "r", "owner": "o"}
    file = OverrideFile.model_validate(head | {"select": [{"nodes": ["*"]}]} | fields)
    return Override.from_file(name, file)


def _shaped(overrides: list[Override]) -> tuple[Any, ...]:
    release = _release()
    by = [(one, effects_on(release, one, CONFIG)) for one in overrides]
    shaped = apply_effects(release, [pair for pair in by if pair[1]], CONFIG)
    assert isinstance(shaped, ServiceRelease)
    values: Any = {}
    for _, patch in shaped.shaping.patches:
        values = overridden(values, patch, None)
    images = {name: shaped.image(name, CONFIG) for name in release.service.images}
    return shaped.replicas, shaped.node, shaped.shaping.held, _text(values), images
