"""A push that fails: the commit, the writer or nobody is refused, whatever the server's words."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from hashlib import sha256
from pathlib import Path

import pytest
import yaml
from demandops.repo.git.remote_repository import GitResult
from demandops.repo.git.repository import MAIN, PushDenied
from demandops.serve import approvals

from tests.kit import config, goals, plain_yaml, rig
from tests.kit.clock import Clock
from tests.kit.git_over_http import Server
from tests.kit.rig import Person, Stages, goal

# ---- one commit is refused ----

# Each refuses the commits of vehicle01's demands, for another reason.
RULES = {
    "message": 'git log --format=%B "$1..$2" | grep -q vehicle01',
    "author": 'git log --format=%an "$1..$2" | grep -q vehicle01',
    "file": 'git log -p "$1..$2" -- ledger | grep -q "^+.*vehicle01"',
}


def _refuse(bare: Path, rule: str) -> None:
    refuse = 'echo "POLICY: nothing about vehicle01" >&2; exit 1'
    rig.hook(
        bare, "pre-receive", f"read old new ref; set -- $old $new; if {rule}; then {refuse}; fi"
    )


def _put(number: int) -> rig.Goal:
    vehicle = f"vehicle{number:02}"
    return goals.put(f"d{number}", vehicle, topic=(f"/vehicles/{vehicle}/ego_data", vehicle))


@pytest.mark.parametrize("rule", RULES)
def test_who_breaks_a_rule_of_the_server_is_told_and_the_others_are_booked(
    url: str, bare: Path, rule: str
) -> None:
    _refuse(bare, RULES[rule])
    with rig.running(url) as generator:
        with rig.busy(generator, _put(3)) as first:
            tickets = [generator.submit(_put(number)) for number in range(3)]
        error = tickets[1].future.exception(rig.PATIENCE_S)
        assert isinstance(error, PushDenied)
        assert "POLICY: nothing about vehicle01" in str(error)
        assert [rig.outcome(each) for each in (first, tickets[0], tickets[2])] == ["booked"] * 3
        assert not generator.remote_status.push_denied
    assert rig.claims(bare, "vehicle01") == []
    rig.assert_sound(bare)


def test_a_demand_that_is_too_large_for_the_server_holds_up_nobody(
    http: str, server: Server, bare: Path, person: Person
) -> None:
    settings = person.read("demandops.yaml")
    patient = f"{settings}\nlimits: {{decisionMilliseconds: 1000000}}\n"  # on a slow machine too
    person.change({"demandops.yaml": patient})
    server.faults.largest_push = 30_000
    large = goals.put("large", "vehicle01", topic=("/a", "vehicle01"))
    large["applications"][0]["inputs"]["ego_data"] = [
        {"topic": f"/t{sha256(b'%d' % number).hexdigest()}", "source": "vehicle01"}
        for number in range(600)
    ]
    with rig.running(http) as generator:
        with rig.busy(generator, goal(0)):
            tickets = generator.submit(large), generator.submit(goal(2))
        with pytest.raises(PushDenied, match="413"):
            rig.receipt(tickets[0])
        assert rig.outcome(tickets[1]) == "booked"
    rig.assert_sound(bare)


def test_people_may_push_while_it_is_found_out_which_commit_is_refused(
    url: str, bare: Path, person: Person
) -> None:
    _refuse(bare, RULES["message"])
    pushed: list[str] = []

    def push(stage: str, text: str) -> None:
        if stage == "committed" and len(pushed) < 3:
            pushed.append(person.push({"README.md": f"{len(pushed)}\n"}))

    with rig.running(url) as generator:
        with rig.busy(generator, goal(5)):
            tickets = [generator.submit(_put(number), listener=push) for number in range(3)]
        assert [*map(rig.outcome, tickets)] == ["booked", "PushDenied", "booked"]
    assert pushed
    rig.assert_sound(bare)


def test_own_work_that_the_server_refuses_holds_up_no_demand(
    url: str, bare: Path, person: Person, clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    head = plain_yaml.load(config.override())
    select = [{"services": ["object-detection"]}]
    fields = {"select": select, "replicas": 3, "expires": "2040-01-01T00:00:00Z"}
    person.override(brief=yaml.safe_dump(head | fields))
    with rig.running(url, runtime=clock, fetch_interval=0.1) as generator:
        rig.book(generator, goal(1))
        rule = 'git log --format=%B "$1..$2" | grep -q expire-override'
        _refuse(bare, rule)
        clock.pass_(500_000_000)
        rig.wait_until(lambda: "rejects the push" in caplog.text, "the end of the override is due")
        rig.book(generator, goal(2), goal(3))
    assert len(rig.operations(bare)) == 3


# ---- every commit is refused: the writer is ----

SSH = """#!/bin/bash
for last; do :; done
case "$last" in
git-upload-pack*) eval "$last";;
git-receive-pack*) [ -e "$0.open" ] || { printf '%b\\n' "$SAYS" >&2; exit 1; }; eval "$last";;
esac
"""
FRAME = "remote: \\nremote: ====\\nremote: \\nremote: {}\\nremote: \\nremote: ====\\nremote: "


@pytest.fixture
def ssh(bare: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A server over SSH that may be read; it may be written while the file ``ssh.open`` exists."""
    program = tmp_path / "ssh"
    program.write_text(SSH)
    program.chmod(0o755)
    monkeypatch.setenv("GIT_SSH_COMMAND", str(program))
    monkeypatch.setenv("GIT_SSH_VARIANT", "simple")
    return program


@pytest.mark.parametrize(
    ("says", "told"),
    [
        ("ERROR: This repository was archived so it is read-only.", "archived"),
        (FRAME.format("ERROR: This deploy key has no write access."), "ERROR: This deploy key has"),
        ("Gitea: User: 3:bot with Key: 5 is not authorized.\\nPlease ask.", "authorized. Please"),
        ("Unauthorized", "Unauthorized"),
    ],
)
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
        assert not generator.remote_status.push_denied
    assert caplog.text.count("the key is read-only") == 1
    rig.assert_sound(bare)


@pytest.mark.parametrize("patience", [0.2, 60.0])
def test_a_proposal_that_the_server_does_not_take_waits_for_a_bounded_time(
    ssh: Path, bare: Path, petra: Person, monkeypatch: pytest.MonkeyPatch, patience: float
) -> None:
    monkeypatch.setattr(approvals, "_REFUSAL_PATIENCE_S", patience)
    monkeypatch.setenv("SAYS", "ERROR: the key is read-only")
    ssh.with_name("ssh.open").touch()  # what Petra changed is rendered
    with rig.running(f"ssh://git@forge{bare}", fetch_interval=0.1) as generator:
        generator.fetch_now()
        rig.wait_until(lambda: not generator.snapshot.problems, "the policy is in effect")
        ssh.with_name("ssh.open").unlink()
        stages = Stages()
        ticket = generator.submit(goal(1), listener=stages)
        if patience < 1:
            with pytest.raises(PushDenied, match="the key is read-only"):
                rig.receipt(ticket)
        else:
            time.sleep(0.5)
            assert not ticket.future.done()
            ssh.with_name("ssh.open").touch()
            rig.wait_until(lambda: "proposed" in stages.names, "it awaits approval")


# ---- nobody is refused ----


def test_a_page_in_the_place_of_a_git_server_is_an_absence(
    http: str, server: Server, bare: Path
) -> None:
    with rig.running(http) as generator:
        rig.book(generator, goal(1))
        server.faults.page = True
        stages = Stages()
        ticket = generator.submit(goal(2), listener=stages)
        rig.wait_until(lambda: "away" in stages.names, "the requester is told")
        assert "a web page" in generator.remote_status.unreachable
        server.faults.page = False
        assert rig.outcome(ticket) == "booked"


@pytest.mark.parametrize(
    ("after", "seconds"),
    [("retry-after: 7", 7.0), ("Retry-After: 86400", 300.0), ("Retry-After: soon", 0.0)],
)
def test_a_rate_limit_is_an_absence_that_says_how_long_it_lasts(after: str, seconds: float) -> None:
    sent = "12:00:00.1 http.c:684 => Send header: GET /s.git/info/refs HTTP/2\n"
    http = f"{sent}<= Recv header: HTTP/2 429\n<= Recv header: {after}\n"
    limited = GitResult(128, "", "fatal: error: 429", http)
    assert limited.is_absence and not limited.is_verdict(MAIN)
    assert limited.retry_after_s == seconds


@pytest.mark.parametrize(
    ("line", "took", "told"),
    [
        (" \t1f:refs/heads/main\ta1..1f", True, ("", "")),
        ("*\t1f:refs/pull/7/head\t[new reference]", False, ("", "")),  # a merge request instead
        ("!\t1f:refs/heads/main\t[rejected] (stale info)", False, ("[rejected]", "stale info")),
        (
            "!\t1f:refs/heads/main\t[remote rejected] (no (not now))",
            False,
            ("[remote rejected]", "no (not now)"),
        ),
    ],
)
def test_what_came_of_a_push_is_read_from_the_line_of_its_branch(
    line: str, took: bool, told: tuple[str, str]
) -> None:
    result = GitResult(int(line[0] == "!"), f"To there\n{line}\nDone\n", "")
    assert result.took(MAIN) is took
    assert result.line_of(MAIN) == told
    assert result.is_verdict(MAIN) is (told[0] == "[remote rejected]")


# ---- a person's settings for git ----


def _request(url: str, tmp_path: Path, settings: str) -> subprocess.CompletedProcess[str]:
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / ".gitconfig").write_text(settings)
    (tmp_path / "demand.yaml").write_text(yaml.safe_dump(goals.put("d", "user")))
    environment = {key: text for key, text in os.environ.items() if key != "GIT_CONFIG_GLOBAL"}
    return subprocess.run(
        [sys.executable, "-m", "demandops.cli.main", "request", "--state-repo", url, "demand.yaml"],
        cwd=tmp_path,
        env=environment | {"HOME": str(tmp_path / "home")},
        capture_output=True,
        text=True,
        check=False,
    )


def test_a_persons_settings_for_git_do_not_reach_the_generators_git(
    http: str, bare: Path, tmp_path: Path
) -> None:
    hooks = tmp_path / "template" / "hooks"
    hooks.mkdir(parents=True)
    for name in ("pre-push", "reference-transaction"):
        rig.hook(tmp_path / "template", name, "echo no >&2; exit 1")
    settings = {
        "core": f"hooksPath = {hooks}",
        "init": f"templateDir = {hooks.parent}",
        "push": "gpgSign = true\n pushOption = ci.skip\n recurseSubmodules = only",
        'remote "origin"': "mirror = true\n pushurl = /nowhere",
        "fetch": "prune = true",
        "color": "ui = always",
        "safe": "bareRepository = explicit",
        "alias": "push = !false",
    }
    text = "".join(f"[{section}]\n {lines}\n" for section, lines in settings.items())
    branches = rig.branches(bare)
    ran = _request(http, tmp_path, text)
    assert (ran.returncode, ran.stderr) == (0, ""), ran
    assert rig.branches(bare) == branches
    rig.assert_sound(bare)


def test_a_broken_file_of_settings_for_git_is_named_and_left_out(
    http: str, bare: Path, tmp_path: Path
) -> None:
    ran = _request(http, tmp_path, "[user]\n name = x\n[broken\n")
    assert ran.returncode == 0, ran
    assert f"{tmp_path}/home/.gitconfig:3" in ran.stderr
    assert "mend that line" in ran.stderr
