"""Goals over ROS 2 that await approval say so, and are then merged, rejected or cancelled."""

from __future__ import annotations

from tests.kit.goals import link as connection
from tests.kit.repo import Person, git
from tests.kit.ros import Client, Sent, Serve


def branch_of(client: Client, sent: Sent) -> str:
    """Wait until a goal's feedback names the branch of its proposal; return the branch."""

    def lines() -> list[str]:
        return [line for line in sent.feedback if line.startswith("awaiting approval: ")]

    client.wait(lambda: bool(lines()))
    return lines()[0].split()[2]


def test_a_goal_stays_open_until_a_person_has_decided(
    serve: Serve, client: Client, person: Person
) -> None:
    bare = person.bare
    person.policy(approval="required")
    served = serve(str(bare))
    client.ready()
    approved, denied, gone = (client.send(connection(number)) for number in (1, 2, 3))
    yes, no, away = (branch_of(client, sent) for sent in (approved, denied, gone))
    assert not any(sent.answered for sent in (approved, denied, gone))
    assert client.cancel(gone)
    client.wait(lambda: gone.answered)
    assert gone.status == "cancelled"
    git(bare, "branch", "--delete", "--force", no)
    client.wait(lambda: denied.answered)
    assert denied.status == "aborted"
    assert denied.message == f"turned-down: was turned down: {no} is gone and was not merged"
    commit = git(bare, "rev-parse", yes)
    git(bare, "update-ref", "refs/heads/main", f"refs/heads/{yes}")
    client.wait(lambda: approved.answered)
    assert (approved.status, approved.message) == ("succeeded", f"booked: {commit}")
    assert list(served.bookkeeping()["connections"]) == ["c1"]
    client.wait(lambda: git(bare, "for-each-ref", "refs/heads/demand") == "")
    assert away != yes
