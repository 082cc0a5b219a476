"""Real HTTP calls to the webhooks of Flux and Argo CD, and their signatures."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

import pytest
from demandops.cluster.clusters_file import ClusterAccess, NoAccess
from demandops.cluster.reconcile_trigger import ReconcileTrigger, signature, web_address

from tests.kit.generator import wait_until
from tests.kit.golden import start
from tests.kit.http import Answer, Server, serving
from tests.unit.cluster.test_reconcile_trigger import trigger

SECRET = "It's a Secret to Everybody"  # noqa: S105 - of an example


@pytest.fixture
def hook() -> Iterator[Server]:
    with serving() as server:
        server.url += "/hook"
        yield server


@pytest.fixture
def secret_file(tmp_path: Path) -> Path:
    file = tmp_path / "secret"
    file.write_text(f"{SECRET}\n")
    file.chmod(0o640)
    return file


def test_the_signature_is_the_one_that_github_documents() -> None:
    """Flux and Argo CD use GitHub's scheme; the values come from GitHub's documentation."""
    documented = "757107ea0eb2509fc211221cce984b8a37570b6d7586c22c46f4379c8b043e17"
    assert signature(SECRET.encode(), b"Hello, World!") == f"sha256={documented}"


def test_a_receiver_of_flux_is_called_with_a_signature(hook: Server, secret_file: Path) -> None:
    trigger("experiment", ClusterAccess(receiver=hook.url, secret_file=secret_file))
    call = hook.calls[0]
    assert call.headers["X-Signature"] == signature(SECRET.encode(), call.body)


def test_argo_cd_is_told_of_a_push_as_github_tells_it(hook: Server, secret_file: Path) -> None:
    changed = [
        "appdefs/x/charts/x/Chart.yaml",
        "clusters/c-its/perception/edge/a.yaml",
        "clusters/other/perception/edge/b.yaml",
        "ledger/applications/aa/b/c.yaml",
    ]
    reached = ClusterAccess(webhook=hook.url, secret_file=secret_file)
    trigger("argocd-experiment", reached, changed)
    headers, event = hook.calls[0].headers, hook.calls[0].json()
    assert headers["X-Hub-Signature-256"] == signature(SECRET.encode(), hook.calls[0].body)
    assert (headers["X-GitHub-Event"], headers["Content-Type"]) == ("push", "application/json")
    assert event["ref"] == "refs/heads/main" and event["after"] == "b" * 40
    # a file of the domain's folder is named, but none of the ledger and of other clusters
    own = "clusters/c-its/perception/_domain.yaml"
    assert event["commits"][0]["modified"] == [changed[0], own, changed[1]]
    trigger("argocd-experiment", reached)  # nothing is known of what changed
    assert hook.calls[-1].json()["commits"] == []


def test_what_changed_is_asked_for_since_the_last_call_that_was_taken(
    hook: Server, secret_file: Path
) -> None:
    asked: list[str] = []

    def changed(since: str) -> tuple[str, list[str]]:
        asked.append(since)
        return f"{len(asked)}", []

    state, _ = start("argocd-experiment")
    reached = ClusterAccess(webhook=hook.url, secret_file=secret_file)
    waker = ReconcileTrigger({"c-its": reached}, changed)
    try:
        hook.answer = lambda call: Answer(503)
        waker(state.config)
        wait_until(lambda: len(hook.calls) >= 1, "call 1")
        hook.answer = lambda call: Answer()
        wait_until(lambda: len(hook.calls) >= 2, "call 2")
        waker(state.config)
        wait_until(lambda: len(hook.calls) >= 3, "call 3")
    finally:
        waker.close()
    assert asked[:3] == ["", "", "2"]


@pytest.mark.parametrize("status", [302, 307, 400])
def test_a_refused_webhook_is_logged_and_no_redirection_followed(
    hook: Server, secret_file: Path, caplog: pytest.LogCaptureFixture, status: int
) -> None:
    hook.answer = lambda call: Answer(status, headers={"Location": "/elsewhere"})
    trigger("experiment", ClusterAccess(receiver=hook.url, secret_file=secret_file))
    assert f"cluster 'c-its' was not woken (it answered {status})" in caplog.text
    assert len(hook.calls) in (1, 2)  # the close may cause a second call
    assert SECRET not in caplog.text and "/hook" not in caplog.text


@pytest.mark.parametrize(
    ("case", "other", "needs"),
    [("experiment", "webhook", "receiver"), ("argocd-experiment", "receiver", "webhook")],
)
def test_the_other_controller_s_webhook_is_not_called(
    hook: Server, caplog: pytest.LogCaptureFixture, case: str, other: str, needs: str
) -> None:
    trigger(case, ClusterAccess.model_validate({other: hook.url}))
    assert hook.calls == []
    assert f"(it has neither a kubeconfig nor a {needs})" in caplog.text


@pytest.mark.parametrize(
    ("repo", "page"),
    [
        ("https://git.example/fleet/repo.git", "https://git.example/fleet/repo"),
        ("https://me:pass@git.example:8443/fleet/repo", "https://git.example/fleet/repo"),
        ("ssh://git@git.example:22/fleet/repo.git", "https://git.example/fleet/repo"),
        ("git@git.example:fleet/repo.git", "https://git.example/fleet/repo"),
        ("file:///srv/fleet.git", None),
    ],
)
def test_a_repository_is_named_by_the_page_that_a_forge_would_name(
    repo: str, page: str | None
) -> None:
    with pytest.raises(NoAccess, match="names no host") if page is None else nullcontext():
        assert web_address(repo) == page
