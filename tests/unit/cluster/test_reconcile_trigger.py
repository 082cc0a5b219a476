"""The file that says which clusters are woken, and waking by webhook; the API's way is in e2e."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from demandops.cluster import access, reconcile_trigger
from demandops.errors import InvalidInput

from tests.kit.golden import start
from tests.kit.http import Answer, Call, kubeconfig, serving

HEAD = "apiVersion: demandops/v1\nkind: ClusterAccess\n"


def unknown(since: str) -> tuple[str, None]:
    """A state repo whose last commit is not known here."""
    return "a" * 40, None


def write(folder: Path, text: str) -> Path:
    file = folder / "clusters.yaml"
    file.write_text(HEAD + text)
    return file


def test_a_file_names_each_cluster_and_how_it_is_reached(tmp_path: Path) -> None:
    file = write(
        tmp_path, "clusters:\n  a: {kubeconfig: /x}\n  b: {receiver: 'https://h/hook/1'}\n"
    )
    clusters = access.read(file).clusters
    assert (clusters["a"].kubeconfig, clusters["b"].receiver) == (Path("/x"), "https://h/hook/1")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("clusters: {a: {}}\n", "clusters.a: needs a kubeconfig, a receiver or a webhook"),
        ("", "clusters: is missing; add it"),
    ],
)
def test_a_wrong_file_is_told_with_field_and_remedy(
    tmp_path: Path, text: str, message: str
) -> None:
    file = write(tmp_path, text)
    with pytest.raises(InvalidInput) as caught:
        access.read(file)
    assert str(caught.value) == f"{file}: {message}"


def test_a_file_that_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput) as caught:
        access.read(tmp_path / "none.yaml")
    assert str(caught.value) == f"{tmp_path}/none.yaml: cannot be read: No such file or directory"


@pytest.fixture
def receiver() -> Iterator[tuple[str, list[str]]]:
    heard: list[str] = []

    def answer(call: Call) -> Answer:
        heard.append(call.path)
        return Answer(503 if "fail" in call.path and len(heard) == 1 else 200)

    with serving(answer) as server:
        yield f"{server.url}/hook/abc", heard


def test_a_receiver_is_called_after_a_push(receiver: tuple[str, list[str]]) -> None:
    url, heard = receiver
    state, _ = start("experiment")
    waker = reconcile_trigger.ReconcileTrigger(
        changes_since=unknown, clusters={"c-its": access.ClusterAccess(receiver=url)}
    )
    waker(state.config)
    waker.close()
    assert set(heard) == {"/hook/abc"}


@pytest.fixture
def api(tmp_path: Path) -> Iterator[tuple[Path, list[tuple[str, bytes]]]]:
    """A server that takes every patch, and a kubeconfig for it."""
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
    state, _ = start(case)
    waker = reconcile_trigger.ReconcileTrigger(
        changes_since=unknown, clusters={"c-its": access.ClusterAccess(kubeconfig=kubeconfig)}
    )
    waker(state.config)
    waker.close()
    assert {asked for asked, _ in heard} == {path}
    assert annotation in heard[0][1]


def test_without_a_push_nobody_is_woken(receiver: tuple[str, list[str]]) -> None:
    url, heard = receiver
    reconcile_trigger.ReconcileTrigger(
        changes_since=unknown, clusters={"c-its": access.ClusterAccess(receiver=url)}
    ).close()
    assert heard == []


def test_a_cluster_that_is_away_is_logged_without_its_secret_and_holds_up_nobody(
    receiver: tuple[str, list[str]], caplog: pytest.LogCaptureFixture
) -> None:
    url, heard = receiver
    state, _ = start("experiment")
    away = access.ClusterAccess(receiver="http://127.0.0.1:1/hook/secret")
    waker = reconcile_trigger.ReconcileTrigger(
        changes_since=unknown, clusters={"away": away, "here": access.ClusterAccess(receiver=url)}
    )
    waker(state.config)
    waker.close()
    assert heard
    assert "cluster 'away' was not woken ([Errno 111] Connection refused; check that" in caplog.text
    assert "secret" not in caplog.text


def test_a_cluster_that_did_not_answer_is_tried_again(receiver: tuple[str, list[str]]) -> None:
    """The receiver answers with a failure at first."""
    url, heard = receiver
    state, _ = start("experiment")
    waker = reconcile_trigger.ReconcileTrigger(
        changes_since=unknown, clusters={"c-its": access.ClusterAccess(receiver=f"{url}?fail=1")}
    )
    try:
        waker(state.config)
        end = time.monotonic() + 30
        while len(heard) < 2:
            assert time.monotonic() < end, "it is not woken again"
            time.sleep(0.05)
    finally:
        waker.close()
