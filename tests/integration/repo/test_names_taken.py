"""What belongs to one claim, release or proposal is not taken by another, whoever writes."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from demandops.base.naming import Subject, SubjectKind
from demandops.model.ledger import claim as claim_files
from demandops.repo import reader
from demandops.repo.merge_check import merge_check
from demandops.repo.write.proposal_branch import branch_name

from tests.kit import rig
from tests.kit.chance import rival
from tests.kit.goals import Goal, application, goal
from tests.kit.repo import Person, branches, read
from tests.kit.rig import Proposed


def joining(id: str, node: str = "edge") -> Goal:
    return goal([application(id, node=node, who=[id[-5:]])], id=f"request {id[-5:]}")


def claims(bare: Path) -> set[str]:
    with reader.opened(str(bare)) as repo:
        ids = {claim.subject.id for claim in repo.snapshot().state.ledger}
        return {id for id in ids if not id.startswith("derived/")}


@pytest.mark.usefixtures("short_digests")
def test_a_claim_by_hand_in_the_file_of_another_is_put_back(bare: Path, person: Person) -> None:
    def path_of(id: str) -> str:
        return claim_files.folder_of(Subject(SubjectKind.APPLICATION, id))

    first, other = "edge/a", rival("edge/a", path_of)
    with rig.running(bare) as generator:
        rig.book(generator, joining(first))
        (path,) = (each for each in rig.claims(bare) if "/applications/" in each)
        data = yaml.safe_load(read(bare, path))
        data["application"]["id"] = other
        text = yaml.safe_dump(data)
        person.write({path: text})
        faults = merge_check.check(person.folder).faults
        assert ("conflict", path) in {(fault.code, fault.file) for fault in faults}
        person.change({path: text})
        rig.book(generator, joining("edge/b"))
        assert claims(bare) == {first, "edge/b"}
        assert yaml.safe_load(read(bare, path))["application"]["id"] == first
    with rig.running(bare) as generator:  # the same after a restart
        rig.book(generator, joining("edge/c"))
        assert claims(bare) == {first, "edge/b", "edge/c"}


@pytest.mark.usefixtures("short_digests")
def test_a_proposal_leaves_the_branch_of_another_alone(bare: Path, petra: Person) -> None:
    operation = rival("op", lambda id: branch_name("d", id.replace("/", "."))).replace("/", ".")
    with rig.running(bare) as generator:
        first = Proposed(generator, goal([application("edge/a")], id="d"), "op")
        branch, before = first.branch, rig.tip(bare)
        commit = rig.git(bare, "rev-parse", branch)
        other = goal([application("edge/b")], id="D")
        assert rig.outcome(generator.submit(other, operation)) == "conflict"
        assert (branches(bare), rig.tip(bare)) == ([branch], before)
        assert rig.git(bare, "rev-parse", branch) == commit
        petra.merge(branch, "--ff-only")
        assert first.outcome() == "booked"
    assert claims(bare) == {"edge/a"}
