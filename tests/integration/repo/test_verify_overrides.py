"""With overrides, `verify` goes from commit to commit, and agrees with `verify --whole`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from demandops.repo import reader
from demandops.repo.verification import Verdict
from demandops.serve import evaluation
from demandops.serve.generator import Generator

from tests.kit import rig
from tests.kit.config import override
from tests.kit.repo import FORGER
from tests.kit.repo import read as file
from tests.kit.rig import Person

FORGED = "Forged\n\nOperation: {}\nDemand-Id: none\n{}Render-Version: 2"
EDGE = "clusters/c-its/perception/edge"


def verdicts(bare: Path) -> dict[str, Verdict]:
    """Return the verdict on each commit, after a check that `verify` and `verify --whole` agree."""
    with reader.opened(str(bare)) as repo:
        commits = repo.revisions(f"{rig.root(bare)}..")
        found = repo.verify(commits)
        assert found == repo.verify(commits, whole=True)
    return {verdict.commit: verdict for verdict in found}


def forged(bare: Path, person: Person, generator: Generator, change: Callable[[], str]) -> Verdict:
    """Make a forged commit between two demands, and return the verdict on the forged commit."""
    rig.book(generator, rig.goal(2))
    made = change()
    found = verdicts(bare)[made]
    rig.book(generator, rig.goal(3))
    return found


HOLD = override({"services": ["object-fusion"]}, hold=True)


def test_a_held_file_must_equal_the_file_of_the_commit_before(
    generator: Generator, bare: Path, person: Person
) -> None:
    rig.book(generator, rig.goal(1))
    person.override(frozen=HOLD)
    rig.book(generator, rig.goal(6), rig.goal(2), rig.leave(2))
    assert all(verdict.holds for verdict in verdicts(bare).values())
    path = next(
        f"{EDGE}/{name}.yaml" for name in rig.books(bare)["services"] if name.startswith("of-")
    )
    text = file(bare, path)
    changed = text.replace("replicas: 1", "replicas: 2")
    assert changed != text
    made = forged(
        bare,
        person,
        generator,
        lambda: person.change({path: changed}, FORGED.format("join", ""), FORGER),
    )
    assert (made.holds, made.differing) == (False, (path,))


def test_a_held_file_that_a_person_edited_is_what_the_next_commits_start_from(
    generator: Generator, bare: Path, person: Person
) -> None:
    rig.book(generator, rig.goal(1), rig.goal(3))
    person.override(frozen=HOLD)
    rig.book(generator, rig.goal(2))
    (path, *_) = [
        f"{EDGE}/{name}.yaml" for name in rig.books(bare)["services"] if name.startswith("of-")
    ]
    person.change({path: file(bare, path).replace("replicas: 1", "replicas: 2")})
    rig.book(generator, rig.leave(2), rig.goal(4))
    assert "replicas: 2" in file(bare, path)
    assert all(verdict.holds for verdict in verdicts(bare).values())


def test_what_a_commit_may_not_change(generator: Generator, bare: Path, person: Person) -> None:
    person.override(brief=override({"nodes": ["edge"]}, keep=True))
    for operation, path in (
        ("join", "ledger/overrides/brief.yaml"),
        ("follow", "ledger/overrides/no-marker.yaml"),
        ("upgrade", "policy/access-domains.yaml"),
        ("follow", "demandops.yaml"),
        ("follow", "README.md"),
    ):
        text = file(bare, path) + "# more\n"
        made = person.change({path: text}, FORGED.format(operation, ""), FORGER)
        rig.book(generator, rig.goal(2), rig.leave(2))
        found = verdicts(bare)[made]
        assert (found.holds, found.touched) == (False, (path,))


def test_a_claim_that_is_kept_is_accounted_for_by_its_override(
    generator: Generator, bare: Path, person: Person
) -> None:
    rig.book(generator, rig.goal(1))
    person.override(lasting=override({"applications": ["edge/*"]}, keep=True))
    rig.book(generator, rig.leave(1))
    (path,) = rig.claims(bare, "override:lasting")
    text = file(bare, path)
    assert all(verdict.holds for verdict in verdicts(bare).values())
    other = text.replace("petra", "paul")
    assert other != text
    message = FORGED.format("follow", "")
    made = forged(bare, person, generator, lambda: person.change({path: other}, message, FORGER))
    assert path in made.touched
    named = FORGED.format("follow", "Override: overrides/lasting.yaml\n")
    made = forged(bare, person, generator, lambda: person.change({path: text}, named, FORGER))
    assert path not in made.touched


def test_rolling_back_leaves_to_overrides_what_they_keep(
    generator: Generator, bare: Path, person: Person
) -> None:
    keep = override({"applications": ["edge/*"]}, keep=True)
    rig.book(generator, rig.goal(1))
    asked = rig.tip(bare)
    person.override(lasting=keep)
    rig.book(generator, rig.leave(1))
    kept = rig.tip(bare)
    assert len(rig.claims(bare, "override:lasting")) == 1

    def back(to: str) -> str:
        goal = evaluation.goal(to, drop_newer=False, reason="x", who=("A", "a@example.org"))
        return rig.receipt(generator.submit(goal)).outcome

    assert back(asked) == "restored", "a claim that an override keeps must not count as newer"
    assert rig.claims(bare, "override:lasting") == [], "a demand takes over from the override"
    rig.book(generator, rig.leave(1))
    assert back(kept) == "unchanged"
    person.override(lasting=None)
    rig.book(generator, rig.goal(2), rig.leave(2))
    assert rig.claims(bare, "override:lasting") == []
    assert back(kept) == "unchanged", "without the override, the rollback must change nothing"
    person.override(lasting=keep)
    rig.book(generator, rig.goal(2), rig.leave(2))
    rolled = evaluation.goal(kept, drop_newer=True, reason="x", who=("A", "a@example.org"))
    assert rig.receipt(generator.submit(rolled)).outcome == "restored"
    assert len(rig.claims(bare, "override:lasting")) == 2
    assert all(verdict.holds for verdict in verdicts(bare).values())
    rig.assert_sound(bare)


def test_rolling_back_leaves_the_markers_alone(
    generator: Generator, bare: Path, person: Person
) -> None:
    rig.book(generator, rig.goal(1))
    before = rig.tip(bare)
    expired = override({"nodes": ["edge"]}, keep=True, expires="2020-01-01T00:00:00Z")
    person.override(brief=expired)
    rig.book(generator, rig.leave(1))
    marker = file(bare, "ledger/overrides/brief.yaml")
    goal = evaluation.goal(before, drop_newer=False, reason="x", who=("A", "a@example.org"))
    assert rig.receipt(generator.submit(goal)).outcome == "restored"
    assert file(bare, "ledger/overrides/brief.yaml") == marker
    rig.assert_sound(bare)
