"""The process runner ends a deleted pod even if no watch reported the deletion."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.e2e.rig.kube import Kube
from tests.kit.generator import wait_until
from tests.kit.http import kubeconfig
from tests.kit.kube_api import kube_api

from . import process_runner
from .process_runner import ProcessRunner


def test_a_pod_that_was_deleted_between_two_watches_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(process_runner, "_WATCH_S", 1)
    spec = {"nodeName": "edge", "containers": [], "volumes": []}
    with kube_api() as api:
        api.put("pods", "perception", "a", {}, metadata={"uid": "1"}, spec=spec)
        kube = Kube(kubeconfig(tmp_path, api.url), tmp_path)
        runner = ProcessRunner(kube, "perception", tmp_path, tmp_path, {})
        try:
            wait_until(lambda: "1" in runner.pods, "the pod runs")
            api.forget("pods", "perception", "a")
            wait_until(lambda: runner.pods["1"].ended is not None, "the pod has ended", 10)
        finally:
            runner.close()
