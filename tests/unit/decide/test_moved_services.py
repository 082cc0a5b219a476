"""When an override moves a service, the inputs and deliveries of the service follow.

When the service moves back, its inputs and deliveries follow again.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator
from dataclasses import replace
from random import Random
from typing import Any

from demandops.base.errors import Refused
from demandops.decide.placement.relocation import changed_claim_files, following_overrides
from demandops.decide.planning.release_keys import all_keys
from demandops.decide.state import rendered_files
from demandops.decide.warnings import policy_warnings
from demandops.model.config.config import Config
from demandops.model.config.override import Override, OverrideFile, Selector
from demandops.model.release import ServiceKey
from hypothesis import given
from hypothesis import strategies as st

from tests.kit.chance import chances, examples
from tests.kit.config import state_of
from tests.kit.memory import MemoryRepo, ledger_in
from tests.unit.decide.test_flows import (
    NODES,
    Demands,
    Graphs,
    assert_every_topic_comes_in_one_way,
    in_clusters,
    instances,
)


def overrides(random: Random, graphs: Graphs) -> Iterator[Override]:
    """Yield random overrides, each of which moves a service, or all services of an application."""
    names = sorted({name for services in graphs.services.values() for name in services})
    for number in range(random.randint(0, 2)):
        by_service = Selector(services=(random.choice(names),))
        file = OverrideFile(
            apiVersion="demandops/v1",
            kind="Override",
            reason="by chance",
            owner="petra",
            priority=number,
            select=(random.choice([by_service, by_service, Selector(applications=("x",))]),),
            node=random.choice(NODES),
        )
        yield Override.from_file(f"o{number}", file)


def wanted(
    graphs: Graphs, app: dict[str, Any], active: Iterable[Override]
) -> dict[str, str | None]:
    """Return the new node of each service of ``app`` that an override moves.

    ``active`` is sorted by priority, and the last override that selects a service wins.
    """
    return {
        name: override.node
        for override in active
        for name, service in graphs.services[app["type"]].items()
        if not service["at_source"] and service["scope"] != "cluster"
        if name in (override.select[0].services or [name] * (app["id"] == "x"))
    }


def configure(repo: MemoryRepo, config: Config) -> tuple[tuple[str, str], ...]:
    """Replace the configuration as a generator does.

    Return (file, reason) for each override that cannot move a service.
    """
    state = state_of(config, repo.state.ledger)
    moved = following_overrides(state)
    for path, text in changed_claim_files(state.ledger, moved.ledger, moved.keys).items():
        repo.files.pop(path) if text is None else repo.files.update({path: text})
    repo.state = replace(state, ledger=moved.ledger)
    for path in in_clusters(repo.files):
        del repo.files[path]
    repo.files |= in_clusters(rendered_files(repo.state))
    return moved.stays


@examples(12)
@given(chances, st.integers(1, 6))
def test_every_topic_comes_in_one_way_while_overrides_move_services(
    random: Random, length: int
) -> None:
    graphs = Graphs(random)
    demands = Demands(random, graphs)
    repo = MemoryRepo(graphs.files)
    plain = repo.config
    for _ in range(length):
        before = copy.deepcopy(demands.held), dict(demands.where)
        taken = repo.take(demands.next())
        if isinstance(taken, Refused):
            demands.held, demands.where = before
            assert {fault.code for fault in taken.faults} == {"conflict"}
        active = {one.name: one for one in overrides(random, graphs)}
        stays = configure(repo, replace(plain, overrides=active))
        ledger = repo.state.ledger
        apps = [app for apps in demands.held.values() for app in apps]
        booked = {app["id"]: ledger.application(app["id"]) for app in apps}
        moved = {id: dict(app.moved) for id, app in booked.items() if app}
        for app in apps:
            if not any(f"'{app['id']}'" in why for _, why in stays):
                assert moved[app["id"]] == wanted(graphs, app, active.values())
        told = [(one.file, one.message) for one in policy_warnings(repo.state)]
        assert {*stays} <= {*told}, "check must tell what stays"
        assert ledger_in(repo.files) == ledger
        running = {key for key in all_keys(repo.state) if isinstance(key, ServiceKey)}
        assert running == {key for app in apps for key in instances(graphs, app, moved[app["id"]])}
        assert_every_topic_comes_in_one_way(repo, demands)
    configure(repo, plain)
    assert not repo.state.ledger.moved_applications()
    assert_every_topic_comes_in_one_way(repo, demands)
