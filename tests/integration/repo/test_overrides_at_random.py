"""A person merges and removes overrides, some of them broken, and deletes claims, at random.

Demands come meanwhile. In the end no trace of the overrides is left, and every commit verifies.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from contextlib import suppress
from datetime import datetime, timedelta, timezone
from pathlib import Path

from demandops.base.errors import DemandOpsError
from demandops.model.ledger.claim import OVERRIDE_PREFIX

from tests.kit import config, rig
from tests.kit.rig import Person

STEPS = 25

Write = Callable[[random.Random], str]


def override(select: dict[str, object], **effects: object) -> Write:
    def write(chance: random.Random) -> str:
        drawn = {
            name: value(chance) if callable(value) else value for name, value in effects.items()
        }
        return config.override(select, **drawn)

    return write


def around_now(chance: random.Random) -> str:
    """Return a random time between one second ago and two seconds ahead."""
    moment = datetime.now(timezone.utc) + timedelta(seconds=chance.uniform(-1, 2))
    return moment.isoformat()


POOL: dict[str, Write] = {
    "frozen": override({"services": ["object-fusion"]}, hold=True, priority=5),
    "frozen-links": override({"connections": ["vehicle0[01]/*", "vehicle02/*"]}, hold=True),
    "lasting": override({"applications": ["edge/*"], "requesters": ["user1", "user5"]}, keep=True),
    "lasting-links": override({"connections": ["*"]}, keep=True, expires=around_now),
    "closed": override({"requesters": ["user2"]}, deny=True),
    "off": override({"services": ["object-detection"]}, deny=True, expires=around_now),
    "many": override({"requesters": ["user4", "user5"]}, replicas=3, priority=3),
    "patched": override(
        {"nodes": ["edge"]}, values={"tolerations": []}, priority=4, expires=around_now
    ),
    "moved": override(
        {"applications": ["edge/fusion-2"]}, node="cloud", priority=lambda c: c.choice([2, 7])
    ),
    "pinned": override(
        {"connections": ["vehicle01/*"]}, images={"mqtt-client": {"tag": "t"}}, priority=9
    ),
    "broken": lambda chance: "apiVersion: [",
    "unfit": override({"services": ["*"]}, values={"replicas": "many"}, priority=77),
    "tied": override({"services": ["*"]}, hold=True, priority=4),
}


def test_whatever_people_merge_history_verifies(address: str, bare: Path, tmp_path: Path) -> None:
    chance = random.Random(1 if address == str(bare) else 2)
    person = Person(bare, tmp_path / "person")
    merged: set[str] = set()
    with rig.running(address) as generator:
        for _ in range(STEPS):
            dice = chance.random()
            if dice < 0.35:
                name = chance.choice([*POOL])
                merged.add(name)
                with suppress(AssertionError):  # nothing to commit
                    person.change({f"overrides/{name}.yaml": POOL[name](chance)})
            elif dice < 0.5 and merged:
                name = chance.choice(sorted(merged))
                merged.remove(name)
                person.change({f"overrides/{name}.yaml": None})
            elif dice < 0.57 and (claims := rig.claims(bare, "Claim")):
                person.change({chance.choice(claims): None})
            else:
                number, leaves = chance.randrange(1, 8), chance.random() < 0.4
                with suppress(DemandOpsError):
                    rig.book(generator, rig.goal(number, shutdown=leaves))
        if merged:
            person.change({f"overrides/{name}.yaml": None for name in merged})
        rig.book(generator, rig.goal(8))
        snapshot = generator.snapshot
    assert snapshot.problems == ()
    assert not any(claim.demand.startswith(OVERRIDE_PREFIX) for claim in snapshot.state.ledger)
    assert rig.git(bare, "ls-tree", "-r", "--name-only", "main", "ledger/overrides/") == ""
    texts = rig.git(
        bare, "grep", "-l", "# override overrides/", "main", "--", "clusters", check=False
    )
    assert texts == ""
    rig.assert_sound(bare)
