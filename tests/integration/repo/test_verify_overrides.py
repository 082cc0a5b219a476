"""With overrides, `verify` goes from commit to commit, and agrees with `verify --whole`."""

from __future__ import annotations

from pathlib import Path

from demandops.repo import reader
from demandops.repo.verification import Verdict
from demandops.serve.generator import Generator

from tests.kit import rig
from tests.kit.config import override
from tests.kit.repo import FORGER
from tests.kit.repo import read as file
from tests.kit.rig import Person

HOLD = override({"services": ["object-fusion"]}, hold=True)
KEEP = override({"applications": ["edge/*"]}, keep=True)


def verdicts(bare: Path) -> dict[str, Verdict]:
    """Return the verdict on each commit, after a check that `verify` and `verify --whole` agree."""
    with reader.opened(str(bare)) as repo:
        commits = repo.revisions(f"{rig.root(bare)}..")
        found = repo.verify(commits)
        assert found == repo.verify(commits, whole=True)
    return {verdict.commit: verdict for verdict in found}


def all_hold(bare: Path) -> bool:
    return all(verdict.holds for verdict in verdicts(bare).values())


def forged(
    bare: Path, person: Person, generator: Generator, path: str, text: str, trailers: str
) -> Verdict:
    """Return the verdict on a forged commit between two demands."""
    rig.book(generator, rig.goal(2))
    assert text != file(bare, path)
    message = f"Forged\n\n{trailers}\nDemand-Id: none\nRender-Version: 3"
    made = person.change({path: text}, message, FORGER)
    rig.book(generator, rig.goal(3))
    return verdicts(bare)[made]


def fusion(bare: Path) -> str:
    name = next(name for name in rig.books(bare)["services"] if name.startswith("of-"))
    return f"clusters/c-its/perception/edge/{name}.yaml"


def test_a_held_file_must_equal_the_file_of_the_commit_before(
    generator: Generator, bare: Path, person: Person
) -> None:
    rig.book(generator, rig.goal(1))
    person.override(frozen=HOLD)
    rig.book(generator, rig.goal(6), rig.goal(2), rig.leave(2))
    assert all_hold(bare)
    path = fusion(bare)
    changed = file(bare, path).replace("replicas: 1", "replicas: 2")
    made = forged(bare, person, generator, path, changed, "Operation: join")
    assert (made.holds, made.differing) == (False, (path,))


def test_a_claim_that_is_kept_is_accounted_for_by_its_override(
    generator: Generator, bare: Path, person: Person
) -> None:
    rig.book(generator, rig.goal(1))
    person.override(lasting=KEEP)
    rig.book(generator, rig.leave(1))
    (path,) = rig.claims(bare, "override:lasting")
    text = file(bare, path)
    assert all_hold(bare)
    other, trailer = text.replace("petra", "paul"), "Operation: follow"
    assert path in forged(bare, person, generator, path, other, trailer).touched
    trailer += "\nOverride: overrides/lasting.yaml"
    assert path not in forged(bare, person, generator, path, text, trailer).touched
