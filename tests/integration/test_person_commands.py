"""Commands that a person runs in their own name; more is in ``stories/people.yaml``."""

from __future__ import annotations

import pytest
from demandops.cli.changes.configure import name_of

from tests.integration.conftest import On
from tests.kit.cli import CTRL_C, Dialogue
from tests.kit.goals import perception
from tests.kit.repo import GitRepo, git

pytestmark = pytest.mark.usefixtures("git_environment")


@pytest.fixture
def joined(on: On, state: GitRepo) -> GitRepo:
    """A state repo with one demand, by vehicle00."""
    on.book(perception())
    return state


def test_a_resume_ends_no_suspension_of_another_selection_with_the_same_name(
    on: On, joined: GitRepo, short_digests: None
) -> None:
    suspend = ("suspend", "--node", "vehicle00", "-m", "Sold", "-y")
    name = name_of({"nodes": ("vehicle00",)})
    patterns = ("vehicle00" + "*" * number for number in range(1, 100))
    rival = next(one for one in patterns if name_of({"nodes": (one,)}) == name)
    assert on(*suspend).code == 0
    before = joined.tip
    assert on("suspend", "--node", rival, "-m", "Sold", "-y").code != 0
    assert on("resume", "--node", rival, "-y").code != 0
    assert joined.tip == before
    assert on("resume", "--node", "vehicle00", "-y").code == 0


def test_a_person_sees_the_consequence_and_is_asked(joined: GitRepo) -> None:
    command = "decommission vehicle00 -m Sold"
    before, asked = joined.tip, (*command.split(), "--state-repo", joined.path)
    for typed, code in (("n\n", 1), (CTRL_C, 130)):
        with Dialogue(*asked) as doubting:
            doubting.read_until("Continue? [y/N]:")
            assert "vehicle00/edge" in doubting.text
            doubting.type(typed)
            assert (doubting.end(), joined.tip) == (code, before)
    assert doubting.text.endswith("^C\ninterrupted\n")
    with Dialogue(*asked) as sure:
        sure.read_until("Continue? [y/N]:")
        sure.type("y\n")
        assert (sure.end(), git(joined, "rev-parse", "main~1")) == (0, before)
    assert "Reason: Sold" in git(joined, "log", "-1", "--format=%b")


def test_a_fleet_is_watched_live(on: On, joined: GitRepo) -> None:
    with Dialogue("watch", "--state-repo", joined.path) as watching:
        watching.read_until("Join ")
        joined.commit({"inventory/README.md": "hello\n"}, "A note on the fleet\n")
        watching.read_until("A note on the fleet")
        valid = joined.files()["inventory/nodes.yaml"]
        joined.commit({"inventory/nodes.yaml": "nodez: []\n"}, "A slip\n")
        watching.read_until("not well: problems in files: ")
        joined.commit({"inventory/nodes.yaml": valid}, "Mended\n")
        watching.read_until("Mended")
        watching.type(CTRL_C)
        assert watching.end() == 0
    assert "watch needs a terminal; use `demandops get KIND --watch`" in on.refused("watch", code=2)
