"""Remotes that are away, silent or refuse: what waits, and who is told."""

from __future__ import annotations

import os
import re
import shutil
import threading
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest
import yaml
from demandops.base.errors import StateRepoError
from demandops.repo.git.remote_repository import GitResult
from demandops.repo.git.repository import MAIN, PushDenied
from demandops.serve import approvals
from demandops.serve.generator import Generator

from tests.kit import goals, plain_yaml, rig
from tests.kit.cli import PROGRAM, process
from tests.kit.clock import Clock
from tests.kit.git_over_http import Server
from tests.kit.repo import program
from tests.kit.rig import NOW, Person, Proposed, Stages, goal

TABLES = plain_yaml.beside(__file__)

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


@pytest.mark.parametrize(("says", "told"), TABLES["unreadable"].values(), ids=TABLES["unreadable"])
def test_a_remote_that_cannot_be_read_is_told_with_its_reason(
    says: list[str], told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The message leaves out git's last lines, which are the same whatever the reason is."""
    words = "\n".join(says)
    begun = "printf '000eversion 2\\n'\n" if len(says) > 1 else ""
    ssh = program(tmp_path / "ssh", f'{begun}echo "{words}" >&2\nexit 255')
    monkeypatch.setenv("GIT_SSH_COMMAND", str(ssh))
    reason = f"^ssh://edge/state.git cannot be fetched: {re.escape(says[0])}{told}"
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


# ---- one commit is refused ----


def test_a_demand_that_is_too_large_for_the_server_holds_up_nobody(
    http: str, server: Server, bare: Path
) -> None:
    server.faults.largest_push = 30_000
    topics = [f"/t{sha256(b'%d' % number).hexdigest()}" for number in range(600)]
    large = goals.goal([], [goals.connection("large", topics=topics)])
    with rig.running(http, runtime=Clock(NOW)) as generator:
        with rig.busy(generator, goal(0)):
            tickets = generator.submit(large), generator.submit(goal(2))
        with pytest.raises(PushDenied, match="413"):
            rig.receipt(tickets[0])
        assert rig.outcome(tickets[1]) == "booked"
    rig.assert_sound(bare)


def test_people_may_push_while_it_is_found_out_which_commit_is_refused(
    url: str, bare: Path, person: Person
) -> None:
    rig.hook(bare, "update", '! git log --format=%B "$2..$3" | grep -q vehicle01')
    pushed: list[str] = []

    def push(stage: str, text: str) -> None:
        if stage == "committed" and len(pushed) < 3:
            pushed.append(person.push({"README.md": f"{len(pushed)}\n"}))

    with rig.running(url) as generator:
        with rig.busy(generator, goal(5, vehicle=3)):
            goals_ = [goal(number, vehicle=number) for number in range(3)]
            tickets = [generator.submit(each, listener=push) for each in goals_]
        assert [*map(rig.outcome, tickets)] == ["booked", "PushDenied", "booked"]
    assert pushed
    rig.assert_sound(bare)


# ---- every commit is refused: the writer is ----


@pytest.mark.parametrize(("says", "told"), TABLES["refusals"])
def test_a_writer_that_is_refused_is_told_the_servers_words(
    ssh: Path, bare: Path, monkeypatch: pytest.MonkeyPatch, says: str, told: str
) -> None:
    monkeypatch.setenv("SAYS", says)
    before = rig.tip(bare)
    with (
        rig.running(f"ssh://git@forge{bare}", refusal_patience_s=0.1) as generator,
        pytest.raises(PushDenied, match=told),
    ):
        rig.receipt(generator.submit(goal(1)))
    assert rig.tip(bare) == before


def test_while_the_writer_is_refused_demands_wait_and_the_status_says_so(
    ssh: Path, bare: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("SAYS", "ERROR: the key is read-only")
    with rig.running(f"ssh://git@forge{bare}") as generator:
        stages = Stages()
        tickets = [generator.submit(goal(1), listener=stages), generator.submit(goal(2))]
        rig.wait_until(lambda: "away" in stages.names, "the requester is told")
        assert "the key is read-only" in generator.remote_status.push_denied
        assert not any(ticket.future.done() for ticket in tickets)
        ssh.with_name("ssh.open").touch()
        assert [*map(rig.outcome, tickets)] == ["booked"] * 2
        assert caplog.text.count("the key is read-only") == 1
    rig.assert_sound(bare)


def test_a_proposal_that_the_server_does_not_take_waits_for_a_bounded_time(
    ssh: Path,
    bare: Path,
    petra: Person,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setenv("SAYS", "ERROR: the key is read-only")
    clock, opened = Clock(), ssh.with_name("ssh.open")
    opened.touch()  # what Petra changed is rendered
    with rig.running(f"ssh://git@forge{bare}", runtime=clock, fetch_interval=0.1) as generator:
        generator.fetch_now()
        rig.wait_until(lambda: not generator.snapshot.problems, "the policy is in effect")
        opened.unlink()
        first = Proposed(generator, goal(1))
        rig.wait_until(lambda: "trying again for some time" in caplog.text, "it is told")
        opened.touch()
        assert first.branch
        opened.unlink()
        late = generator.submit(goal(2))
        rig.wait_until(lambda: caplog.text.count("for some time") == 2, "it is told")
        assert not late.future.done()
        clock.pass_(approvals._REFUSAL_PATIENCE_S)
        with pytest.raises(PushDenied, match="the key is read-only"):
            rig.receipt(late)


# ---- nobody is refused ----


@pytest.mark.parametrize(("after", "seconds"), TABLES["rate limits"])
def test_a_rate_limit_is_an_absence_that_says_how_long_it_lasts(after: str, seconds: float) -> None:
    sent = "12:00:00.1 http.c:684 => Send header: GET /s.git/info/refs HTTP/2\n"
    http = f"{sent}<= Recv header: HTTP/2 429\n<= Recv header: {after}\n"
    limited = GitResult(128, "", "fatal: error: 429", http)
    assert limited.is_absence and not limited.is_verdict(MAIN)
    assert limited.retry_after_s == seconds


@pytest.mark.parametrize(("line", "took", "told"), TABLES["lines of a push"])
def test_what_came_of_a_push_is_read_from_the_line_of_its_branch(
    line: str, took: bool, told: list[str]
) -> None:
    result = GitResult(int(line[0] == "!"), f"To there\n{line}\nDone\n", "")
    assert result.took(MAIN) is took
    assert [*result.line_of(MAIN)] == told
    assert result.is_verdict(MAIN) is (told[0] == "[remote rejected]")


# ---- a person's settings for git ----


def test_a_persons_settings_for_git_do_not_reach_the_generators_git(
    http: str, bare: Path, tmp_path: Path
) -> None:
    """A file that cannot be read is named, and left out."""
    hooks, home = tmp_path / "template" / "hooks", tmp_path / "home"
    hooks.mkdir(parents=True)
    home.mkdir()
    for name in ("pre-push", "reference-transaction"):
        rig.hook(tmp_path / "template", name, "echo no >&2; exit 1")
    settings = TABLES["settings"].replace("TEMPLATE", str(hooks.parent))
    (home / ".gitconfig").write_text(settings)
    (tmp_path / "demand.yaml").write_text(yaml.safe_dump(goals.put("d", "user")))
    environment = {key: text for key, text in os.environ.items() if key != "GIT_CONFIG_GLOBAL"}
    environment["HOME"] = str(home)
    request = (*PROGRAM, "request", "--state-repo", http, "demand.yaml")
    branches = rig.branches(bare)
    ran = process(*request, cwd=tmp_path, env=environment)
    assert (ran.code, ran.err) == (0, ""), ran
    assert rig.branches(bare) == branches
    rig.assert_sound(bare)
    (home / ".gitconfig").write_text("[user]\n name = x\n[broken\n")
    ran = process(*request, cwd=tmp_path, env=environment)
    assert ran.code == 0, ran
    assert f"{home}/.gitconfig:3" in ran.err and "mend that line" in ran.err


# ---- a running generator follows what people merge, even if no demand comes ----

SOON_S = 0.1


def test_off_means_off(url: str, bare: Path, person: Person, tmp_path: Path) -> None:
    with (
        rig.running(url) as off,
        rig.running(url, fetch_interval=SOON_S, data=tmp_path / "other") as on,
    ):
        rig.book(off, goal(1))
        known = str(off.snapshot.commit)
        made = person.edit("inventory/brokers.yaml", "service-mqtt-broker-edge", "elsewhere")
        rig.wait_until(lambda: rig.tip(bare) != made, "the other generator follows")
        commit = rig.tip(bare)
        rig.wait_until(lambda: str(on.snapshot.commit) == commit, "the other generator knows")
        assert str(off.snapshot.commit) == known
        off.fetch_now()  # as after a webhook's call
        rig.wait_until(lambda: str(off.snapshot.commit) == commit, "the generator follows now")


# ---- the remote is slow, or away ----


def test_a_fetch_that_hangs_delays_no_demand(http: str, server: Server, bare: Path) -> None:
    with rig.running(http, fetch_interval=SOON_S) as generator:
        rig.book(generator, goal(1))
        hang = server.faults.hang = threading.Event()
        repository: Any = generator._repository
        rig.wait_until(lambda: server.faults.hanging and repository._process, "a fetch hangs")
        talking = repository._process
        stages = Stages()
        ticket = generator.submit(goal(2), listener=stages)
        rig.wait_until(
            lambda: "committed" in stages.names, "the demand is committed although the fetch hangs"
        )
        assert talking.poll() is not None, "the fetch must be ended for the demand"
        assert not generator.remote_status.unreachable
        server.faults.hang = None
        hang.set()
        assert rig.receipt(ticket).outcome == "booked"
    rig.assert_sound(bare)


@pytest.mark.parametrize("sends", [False, True], ids=["a look", "a push"])
def test_stopping_does_not_wait_for_a_server_that_never_answers(
    http: str, server: Server, bare: Path, sends: bool
) -> None:
    generator = Generator(http, fetch_interval=0 if sends else SOON_S)
    hang = server.faults.hang = threading.Event()
    try:
        if sends:
            generator.submit(goal(1), "op-1")
        rig.wait_until(lambda: server.faults.hanging, "the server has a request")
        stopped = generator.stop(timeout=0.5 if sends else 2 * rig.PATIENCE_S)
        assert stopped.result(rig.PATIENCE_S) is not sends
    finally:
        server.faults.hang = None
        hang.set()
    assert rig.restart(http) is True
    assert rig.operations(bare) == ["op-1"] * sends
