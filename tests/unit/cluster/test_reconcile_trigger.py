"""The clusters file, and the calls of a trigger to a cluster's API or webhook."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from demandops.cluster import clusters_file
from demandops.cluster.reconcile_trigger import ReconcileTrigger
from demandops.errors import InvalidInput

from tests.kit.golden import start
from tests.kit.http import Answer, Call, kubeconfig, serving

HEAD = "apiVersion: demandops/v1\nkind: ClusterAccess\n"


def trigger(
    case: str, reached: clusters_file.ClusterAccess, changed: list[str] | None = None
) -> None:
    """Trigger the cluster of a golden case once; ``changed`` lists the paths that have changed."""
    state, _ = start(case)
    made = ReconcileTrigger({"c-its": reached}, lambda since: ("b" * 40, changed))
    made(state.config)
    made.close()


def test_a_file_names_each_cluster_and_how_it_is_reached(tmp_path: Path) -> None:
    file = tmp_path / "clusters.yaml"
    file.write_text(
        f"{HEAD}clusters: {{a: {{kubeconfig: /x}}, b: {{receiver: https://h/hook/1}}}}\n"
    )
    clusters = clusters_file.read(file).clusters
    assert (clusters["a"].kubeconfig, clusters["b"].receiver) == (Path("/x"), "https://h/hook/1")


SIGNED = "clusters: {a: {receiver: 'http://h/hook', secret_file: SECRET}}\n"
NO_FILE = "cannot be read: No such file or directory"
OPEN = "SECRET may be read by everybody on this machine; run chmod o= on it"


@pytest.mark.parametrize(
    ("text", "secret", "mode", "message"),
    [
        (None, None, 0, f"{NO_FILE}; check the path"),
        ("clusters: {a: {}}\n", None, 0, "clusters.a: needs a kubeconfig, a receiver or a webhook"),
        ("", None, 0, "clusters: is missing; add it"),
        (SIGNED, None, 0, f"clusters.a.secret_file: SECRET {NO_FILE}; put the secret there"),
        (SIGNED, "", 0o600, "clusters.a.secret_file: SECRET is empty; put the secret there"),
        (SIGNED, " \r\n", 0o600, "clusters.a.secret_file: SECRET is empty; put the secret there"),
        (SIGNED, "x", 0o644, f"clusters.a.secret_file: {OPEN}"),
        ("clusters: {a: {kubeconfig: /k, secret_file: /s}}\n", None, 0,
         "clusters.a: has a secret_file but no URL; add a receiver or a webhook"),
    ],
)  # fmt: skip
def test_a_file_that_cannot_be_used_is_told_with_field_and_remedy(
    tmp_path: Path, text: str | None, secret: str | None, mode: int, message: str
) -> None:
    file, secret_file = tmp_path / "clusters.yaml", tmp_path / "secret"
    if text is not None:
        file.write_text(HEAD + text.replace("SECRET", str(secret_file)))
    if secret is not None:
        secret_file.write_text(secret)
        secret_file.chmod(mode)
    with pytest.raises(InvalidInput) as caught:
        clusters_file.read(file)
    place = f"{file}:3" if message.startswith("clusters.") else file
    assert str(caught.value) == f"{place}: {message.replace('SECRET', str(secret_file))}"


@pytest.fixture
def receiver() -> Iterator[tuple[str, list[str]]]:
    heard: list[str] = []

    def answer(call: Call) -> Answer:
        heard.append(call.path)
        return Answer()

    with serving(answer) as server:
        yield f"{server.url}/hook/abc", heard


@pytest.fixture
def api(tmp_path: Path) -> Iterator[tuple[Path, list[tuple[str, bytes]]]]:
    """A kubeconfig for a server that accepts every patch, and the list of its patches."""
    heard: list[tuple[str, bytes]] = []

    def answer(call: Call) -> Answer:
        assert call.method == "PATCH"
        heard.append((call.path, call.body))
        return Answer.json({})

    with serving(answer) as server:
        yield kubeconfig(tmp_path, server.url), heard


@pytest.mark.parametrize(
    ("case", "path", "annotation"),
    [
        (
            "experiment",
            "/apis/source.toolkit.fluxcd.io/v1/namespaces/perception/gitrepositories/demandops",
            b"reconcile.fluxcd.io/requestedAt",
        ),
        (
            "argocd-experiment",
            "/apis/argoproj.io/v1alpha1/namespaces/argocd/applications/demandops-perception",
            b"argocd.argoproj.io/refresh",
        ),
    ],
)
def test_the_object_that_fetches_is_annotated(
    api: tuple[Path, list[tuple[str, bytes]]], case: str, path: str, annotation: bytes
) -> None:
    kubeconfig, heard = api
    trigger(case, clusters_file.ClusterAccess(kubeconfig=kubeconfig))
    assert {asked for asked, _ in heard} == {path}
    assert annotation in heard[0][1]


def test_without_a_push_nobody_is_woken(receiver: tuple[str, list[str]]) -> None:
    url, heard = receiver
    reached = clusters_file.ClusterAccess(receiver=url)
    ReconcileTrigger({"c-its": reached}, lambda since: ("", None)).close()
    assert heard == []


def test_a_cluster_that_is_away_is_logged_without_its_secret_and_holds_up_nobody(
    receiver: tuple[str, list[str]], caplog: pytest.LogCaptureFixture
) -> None:
    url, heard = receiver
    state, _ = start("experiment")
    away = clusters_file.ClusterAccess(receiver="http://127.0.0.1:1/hook/secret")
    clusters = {"away": away, "here": clusters_file.ClusterAccess(receiver=url)}
    waker = ReconcileTrigger(clusters, lambda since: ("", None))
    waker(state.config)
    waker.close()
    assert heard
    assert "cluster 'away' was not woken ([Errno 111] Connection refused; check that" in caplog.text
    assert "secret" not in caplog.text
