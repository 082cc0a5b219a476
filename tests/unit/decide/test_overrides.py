"""Overrides: what patches make of Helm values, and who is warned of ties."""

from __future__ import annotations

from functools import lru_cache, partial
from json import dumps
from typing import Any

import pytest
from demandops.decide.planning.overrides import apply_effects, effects_on
from demandops.decide.state import trial_releases
from demandops.decide.warnings import tied_override_warnings
from demandops.model.config.override import Override
from demandops.model.release import ServiceRelease
from demandops.templating.charts import merged, overridden
from hypothesis import given
from hypothesis import strategies as st

from tests.kit import plain_yaml
from tests.kit.chance import examples
from tests.kit.config import override_of
from tests.kit.memory import MemoryRepo

CONFIG = MemoryRepo().config
ALL = {"nodes": ["*"]}

json = st.recursive(
    st.none() | st.booleans() | st.integers(0, 2) | st.sampled_from("xy"),
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(st.sampled_from("kl"), inner),
    max_leaves=4,
)
_text = partial(dumps, sort_keys=True)
patch = st.fixed_dictionaries({}, optional={"k": json, "l": json})


@examples(100)
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


TABLES = plain_yaml.beside(__file__)
DEFAULTS = TABLES["defaults"]


@pytest.mark.parametrize(("values", "patches", "result", "in_helm"), TABLES["nulls"])
def test_null_removes_what_the_template_wrote_and_what_the_chart_has(
    values: dict[str, Any], patches: list[dict[str, Any]], result: Any, in_helm: Any
) -> None:
    for each in patches:
        values = overridden(values, each, DEFAULTS)
    assert result is None or values == result
    coalesced = merged(DEFAULTS, values)
    assert in_helm is None or coalesced == {"env": {}} | in_helm
    assert None not in (*coalesced.values(), *coalesced.get("limits", {}).values())


@lru_cache
def _release() -> ServiceRelease:
    (made,) = trial_releases(CONFIG).values()
    return made[0]


@pytest.mark.parametrize(("one", "other", "tied"), TABLES["tied"], ids=str)
def test_a_tie_is_told_where_the_order_of_names_decides(
    one: dict[str, Any], other: dict[str, Any], tied: bool
) -> None:
    both = [override_of("one", ALL, **one), override_of("other", ALL, **other)]
    first, second = (_shaped(order) for order in (both, both[::-1]))
    told = {(each.file, each.field) for each in tied_override_warnings([first])}
    assert told == ({("overrides/other.yaml", "priority")} if tied else set())
    assert bool([*tied_override_warnings([second])]) is tied
    assert tied or "priority" in other or _made(first) == _made(second)


def _shaped(overrides: list[Override]) -> ServiceRelease:
    release = _release()
    by = [(one, effects_on(release, one, CONFIG)) for one in overrides]
    shaped = apply_effects(release, [pair for pair in by if pair[1]], CONFIG)
    assert isinstance(shaped, ServiceRelease)
    return shaped


def _made(shaped: ServiceRelease) -> tuple[Any, ...]:
    values: Any = {}
    for _, patch in shaped.shaping.patches:
        values = overridden(values, patch, None)
    images = {name: shaped.image(name, CONFIG) for name in shaped.service.images}
    return shaped.replicas, shaped.node, shaped.shaping.held, _text(values), images
