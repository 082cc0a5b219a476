"""Demands wait while the remote is away, and fail if the remote denies their push."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest
from demandops.base.errors import StateRepoError
from demandops.serve.generator import Generator

from tests.kit import rig
from tests.kit.rig import Person, goal

# ---- away and back ----


def test_without_a_clone_a_remote_that_is_away_is_told_at_once(bare: Path) -> None:
    with pytest.raises(StateRepoError, match="cannot be fetched"):
        Generator(bare.with_name("nothing.git").as_uri())


# ---- denied ----


def test_a_server_that_cannot_store_a_push_now_is_waited_for(
    url: str, bare: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with rig.running(url) as generator:
        objects, aside = bare / "objects", bare / "objects.aside"
        objects.rename(aside)
        (objects / "info").mkdir(parents=True)
        (objects / "info" / "alternates").write_text(f"{aside}\n")
        for number in range(256):  # the server fails to store objects
            (objects / f"{number:02x}").touch()
        ticket = generator.submit(goal(1))
        rig.wait_until(lambda: "rejects the push: un" in caplog.text, "the log says why")
        assert not ticket.future.done()
        shutil.rmtree(objects)
        aside.rename(objects)
        assert rig.receipt(ticket).outcome == "booked"
    rig.assert_sound(bare)


@pytest.mark.parametrize(
    ("server", "told"),
    [
        (["git@edge: Permission denied (publickey)"], "; git needs credentials"),
        (  # the server ends in the middle of its answer, and git complains of that last
            [
                "warning: unable to access 'config': Input/output error",
                "fatal: unknown error occurred while reading the configuration files",
            ],
            "$",
        ),
        (  # the server could not read the reference from its disk, and names a null id
            [f"fatal: git upload-pack: not our ref {'0' * 40}"],
            "; the server cannot read the branch",
        ),
        (
            ["fatal: detected dubious ownership in repository at '/srv/state.git'"],
            "; .* who owns the repository's files",
        ),
    ],
    ids=["credentials", "cut off", "no reference", "owner"],
)
def test_a_remote_that_cannot_be_read_is_told_with_its_reason(
    server: list[str], told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The message leaves out git's last lines, which are the same whatever the reason is."""
    ssh, words = tmp_path / "ssh", "\n".join(server)
    begun = "printf '000eversion 2\\n'\n" if len(server) > 1 else ""
    ssh.write_text(f'#!/bin/sh\n{begun}echo "{words}" >&2\nexit 255\n')
    ssh.chmod(0o755)
    monkeypatch.setenv("GIT_SSH_COMMAND", str(ssh))
    reason = f"^ssh://edge/state.git cannot be fetched: {re.escape(server[0])}{told}"
    with pytest.raises(StateRepoError, match=reason):
        Generator("ssh://git@edge/state.git")


def test_a_remote_with_main_checked_out_is_told_instead_of_tried_for_ever(
    bare: Path, person: Person
) -> None:
    person.fetch()
    with rig.running(person.folder.as_uri(), refusal_patience_s=0.5) as generator:
        ticket = generator.submit(goal(1))
        with pytest.raises(StateRepoError, match="checked out"):
            rig.receipt(ticket)
