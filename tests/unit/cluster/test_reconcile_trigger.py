"""The clusters file, and the calls of a trigger to a cluster's API or webhook."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from math import inf
from pathlib import Path

import pytest
from demandops.base.errors import InvalidInput
from demandops.base.http_call import NoAnswer
from demandops.cluster import clusters_file, reconcile_trigger
from demandops.cluster.clusters_file import ClusterAccess
from demandops.cluster.health import REQUESTED_AT
from demandops.cluster.reconcile_trigger import ReconcileTrigger, _Wake, signature, web_address

from tests.golden.cases import start
from tests.kit import plain_yaml
from tests.kit.cli import Run
from tests.kit.cluster import KubeApi, kube_api
from tests.kit.http import Answer, Server, kubeconfig, serving
from tests.kit.limits import PATIENCE_S
from tests.kit.rig import wait_until

TABLES = plain_yaml.beside(__file__, "clusters")
SOURCED = {"sourceRef": {"name": "demandops"}}
HEAD = "apiVersion: demandops/v1\nkind: ClusterAccess\n"


@pytest.fixture(autouse=True)
def _patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a trigger that closes finish its calls, however busy this machine is."""
    monkeypatch.setattr(reconcile_trigger, "_TIMEOUT_S", PATIENCE_S)


def trigger(case: str, reached: ClusterAccess, changed: list[str] | None = None) -> None:
    """Run the trigger once for the configuration of a golden case.

    ``changed`` lists the paths that have changed, as after a push.
    """
    state, _ = start(case)
    made = ReconcileTrigger({"c-its": reached}, lambda since: ("b" * 40, changed))
    made(state.config)
    made.close()


@pytest.mark.parametrize(("access", "secret", "mode", "field", "told"), TABLES["mistakes"])
def test_a_file_that_cannot_be_used_is_told_with_field_and_remedy(
    tmp_path: Path, access: str, secret: str | None, mode: int, field: str, told: str
) -> None:
    file, secret_file = tmp_path / "clusters.yaml", tmp_path / "secret"
    access = access.replace("SECRET", str(secret_file))
    file.write_text(f"{HEAD}clusters: {{a: {access}}}\n")
    if secret is not None:
        secret_file.write_text(secret)
        secret_file.chmod(mode)
    with pytest.raises(InvalidInput) as caught:
        clusters_file.read(file)
    (fault,) = caught.value.faults
    assert (fault.file, fault.line, fault.field) == (str(file), 3, field)
    assert told in fault.message


def test_a_file_that_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="cannot be read: No such file"):
        clusters_file.read(tmp_path / "clusters.yaml")


@pytest.fixture
def api() -> Iterator[KubeApi]:
    with kube_api() as server:
        yield server


def reached(api: KubeApi, folder: Path) -> ClusterAccess:
    return ClusterAccess(kubeconfig=kubeconfig(folder, api.url))


@pytest.mark.parametrize(("case", "path", "annotation"), TABLES["annotated"])
def test_the_object_that_fetches_is_annotated(
    api: KubeApi, tmp_path: Path, case: str, path: str, annotation: str
) -> None:
    trigger(case, reached(api, tmp_path))
    assert {asked for asked, _ in api.patches} == {f"/apis/{path}"}
    assert annotation in api.patches[0][1]["metadata"]["annotations"]


def fetch_and_apply(api: KubeApi, commit: str) -> None:
    """Have the API report that Flux has handled the last request, and applied ``commit``."""
    asked = api.patches[-1][1]["metadata"]["annotations"] if api.patches else {}
    artifact = {"revision": f"main@sha1:{commit}"}
    status = {"lastHandledReconcileAt": asked.get(REQUESTED_AT, ""), "artifact": artifact}
    api.put("gitrepositories", "perception", "demandops", status, metadata={"annotations": asked})
    ready = {"type": "Ready", "status": "True"}
    status = {"lastAttemptedRevision": f"main@sha1:{commit}", "conditions": [ready]}
    api.put("kustomizations", "perception", "perception", status, spec=SOURCED)


def test_flux_is_woken_again_a_second_after_it_became_idle_or_after_a_minute() -> None:
    busy = _Wake("c-its", (), pushed=100.0, idle_from=inf)
    assert busy.due == 160
    assert replace(busy, idle_from=130.0).due == 131
    assert replace(busy, idle_from=130.0, next_try=140.0).due == 140, "a failed call waits"
    assert replace(busy, pushed=None).due == inf, "without a push nobody is woken"


def test_a_push_waits_until_flux_is_idle_which_the_end_does_not_miss(
    api: KubeApi, tmp_path: Path
) -> None:
    state, _ = start("experiment")
    fetch_and_apply(api, "a")
    waker = ReconcileTrigger({"c-its": reached(api, tmp_path)}, lambda since: ("", None))
    waker(state.config)
    wait_until(lambda: len(api.patches) == 1, "the first call")
    waker(state.config)
    fetch_and_apply(api, "b")
    waker.close()
    assert len(api.patches) == 2


def test_a_cluster_that_is_away_is_logged_without_its_secret_and_holds_up_nobody(
    caplog: pytest.LogCaptureFixture,
) -> None:
    state, _ = start("experiment")
    away = ClusterAccess(receiver="http://127.0.0.1:1/hook/secret")
    with serving() as server:
        here = ClusterAccess(receiver=f"{server.url}/hook/abc")
        waker = ReconcileTrigger({"away": away, "here": here}, lambda since: ("", None))
        assert server.calls == [], "without a push nobody is woken"
        waker(state.config)
        waker.close()
        assert server.calls
    assert "cluster 'away' was not woken ([Errno 111] Connection refused; check that" in caplog.text
    assert "secret" not in caplog.text


def test_a_new_kubeconfig_counts_at_the_next_try(
    api: KubeApi, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    state, _ = start("experiment")
    file = kubeconfig(tmp_path, "http://127.0.0.1:1")
    waker = ReconcileTrigger({"c-its": ClusterAccess(kubeconfig=file)}, lambda since: ("", None))
    waker(state.config)
    wait_until(lambda: "was not woken" in caplog.text, "the first try")
    kubeconfig(tmp_path, api.url)
    wait_until(lambda: api.patches, "the next try")
    waker.close()


def test_an_odd_object_keeps_no_cluster_from_being_woken(api: KubeApi, tmp_path: Path) -> None:
    fetch_and_apply(api, "a")
    odd = {"lastAttemptedRevision": "main@sha1:a", "conditions": [None]}
    api.put("kustomizations", "perception", "perception", odd, spec=SOURCED)
    trigger("experiment", reached(api, tmp_path))
    assert len(api.patches) == 1


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


def test_a_receiver_of_flux_is_called_with_the_signature_that_github_documents(
    hook: Server, secret_file: Path
) -> None:
    documented = "757107ea0eb2509fc211221cce984b8a37570b6d7586c22c46f4379c8b043e17"
    assert signature(SECRET.encode(), b"Hello, World!") == f"sha256={documented}"
    trigger("experiment", ClusterAccess(receiver=hook.url, secret_file=secret_file))
    call = hook.calls[0]
    assert call.headers["X-Signature"] == signature(SECRET.encode(), call.body)


def test_a_person_wakes_a_cluster_by_name(
    hook: Server, secret_file: Path, tmp_path: Path, demandops: Run
) -> None:
    assert demandops("init", tmp_path / "fleet.git", "--bare").code == 0
    file = tmp_path / "clusters.yaml"
    access = f"receiver: {hook.url}, secret_file: {secret_file}, wake: false"
    file.write_text(f"{HEAD}clusters: {{c-its: {{{access}}}, away: {{webhook: {hook.url}}}}}\n")
    where = ("--clusters", file, "--state-repo", tmp_path / "fleet.git")
    assert demandops("reconcile", "c-its", *where).out == "c-its is woken\n"
    assert hook.calls[0].headers["X-Signature"] == signature(SECRET.encode(), hook.calls[0].body)
    failed = demandops("reconcile", "away", *where)
    assert (failed.code, failed.err) == (
        1,
        "error: cluster 'away' was not woken: it has neither a kubeconfig nor a receiver\n",
    )
    assert "has no cluster 'c-it'; did you mean" in demandops("reconcile", "c-it", *where).err
    assert demandops("reconcile", *where).code == 2


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


def test_the_other_controller_s_webhook_is_not_called(
    hook: Server, caplog: pytest.LogCaptureFixture
) -> None:
    trigger("experiment", ClusterAccess(webhook=hook.url))
    trigger("argocd-experiment", ClusterAccess(receiver=hook.url))
    assert hook.calls == []
    for needs in ("receiver", "webhook"):
        assert f"(it has neither a kubeconfig nor a {needs})" in caplog.text


@pytest.mark.parametrize(("repo", "page"), TABLES["pages"])
def test_a_repository_is_named_by_the_page_that_a_forge_would_name(
    repo: str, page: str | None
) -> None:
    with pytest.raises(NoAnswer, match="names no host") if page is None else nullcontext():
        assert web_address(repo) == page
