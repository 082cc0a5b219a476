"""Goals that await approval over real ROS 2: feedback, the merge, turning down, cancelling."""

from __future__ import annotations

from pathlib import Path

import yaml

from tests.kit.goals import link as connection
from tests.kit.repo import POLICY, GitRepo, git
from tests.kit.repo import init as new_state_repo
from tests.kit.repo import read as text
from tests.kit.ros import Client, Sent, Serve


def branch_of(client: Client, sent: Sent) -> str:
    """Wait until a goal's feedback names its branch."""

    def told() -> list[str]:
        return [line for line in sent.feedback if line.startswith("awaiting approval: ")]

    client.wait(lambda: bool(told()))
    return told()[0].split()[2]


def test_a_goal_stays_open_until_a_person_has_decided(
    serve: Serve, client: Client, tmp_path: Path
) -> None:
    bare = new_state_repo(tmp_path / "strict.git")
    policy = yaml.safe_load(text(bare, POLICY))
    policy["domains"][0]["approval"] = "required"
    GitRepo(bare).commit({POLICY: yaml.safe_dump(policy)})
    served = serve(str(bare))
    client.ready()
    approved, denied, gone = (client.send(connection(number)) for number in (1, 2, 3))
    yes, no, away = (branch_of(client, sent) for sent in (approved, denied, gone))
    assert not any(sent.answered for sent in (approved, denied, gone))
    assert client.cancel(gone)
    client.wait(lambda: gone.answered)
    assert gone.status == "cancelled"
    git(str(bare), "branch", "--delete", "--force", no)
    client.wait(lambda: denied.answered)
    assert denied.status == "aborted"
    assert denied.message == f"turned-down: was turned down: {no} is gone and was not merged"
    commit = git(str(bare), "rev-parse", yes)
    git(str(bare), "update-ref", "refs/heads/main", f"refs/heads/{yes}")
    client.wait(lambda: approved.answered)
    assert (approved.status, approved.message) == ("succeeded", f"booked: {commit}")
    assert list(served.bookkeeping()["connections"]) == ["c1"]
    client.wait(lambda: git(str(bare), "for-each-ref", "refs/heads/demand") == "")
    assert away != yes
