"""A ConfigMap is watched over real HTTP: what the watch passes on, and what it logs."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from threading import Event
from typing import Any

import pytest
from demandops.base.errors import InvalidInput
from demandops.cluster.config_map_watch import ConfigMapWatch

from tests.kit.http import Answer, Call, kubeconfig, serving
from tests.kit.limits import PATIENCE_S

ITEM = {"metadata": {"name": "of-params", "resourceVersion": "1"}, "data": {"params.yml": "a"}}
NAME = "ConfigMap perception/of-params"


def test_data_of_a_deleted_config_map_stay_valid(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    items: list[list[Any]] = [[], [ITEM], []]
    is_read, passed_on = Event(), list[Mapping[str, str]]()

    def answer(call: Call) -> Answer:
        if "watch=" in call.path:
            gone = {"type": "DELETED", "object": ITEM}
            return Answer.json(gone if len(items) == 1 else {})
        if not items:
            is_read.set()
            return Answer.json({"reason": "over"}, 503)
        return Answer.json({"metadata": {"resourceVersion": "1"}, "items": items.pop(0)})

    monkeypatch.setattr(logging.getLogger("demandops"), "propagate", True)
    with serving(answer) as server:
        config = kubeconfig(tmp_path, server.url)
        watch = ConfigMapWatch(
            "perception", "of-params", lambda data: passed_on.append({**data}), config
        )
        assert is_read.wait(PATIENCE_S)
        watch.close()
    assert passed_on == [{"params.yml": "a"}]
    assert [message for message in caplog.messages if "retrying" not in message] == [
        f"{NAME} does not exist yet",
        f"{NAME} is gone; its last data stay valid",
    ]


def test_without_a_kubeconfig_the_process_must_be_a_pod(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("KUBERNETES_SERVICE_HOST", raising=False)
    with pytest.raises(InvalidInput) as refused:
        ConfigMapWatch("perception", "of-params", print, None)
    assert str(refused.value).startswith(
        "without --kubeconfig: needs a pod with a service account's token: "
    )
