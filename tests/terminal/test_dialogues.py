"""Commands on a pseudoterminal: their questions, and their output while git is slow."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from tests.kit.cli import CTRL_C, Dialogue
from tests.kit.http import kubeconfig
from tests.kit.repo import GitRepo


@pytest.mark.nightly  # sees whole seconds pass
def test_a_cluster_that_does_not_answer_is_waited_for_until_ctrl_c_or_a_time_has_passed(
    state: GitRepo, tmp_path: Path
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        config = kubeconfig(tmp_path, f"http://127.0.0.1:{silent.getsockname()[1]}")
        clusters = tmp_path / "clusters.yaml"
        clusters.write_text(
            "apiVersion: demandops/v1\nkind: ClusterAccess\n"
            f"clusters: {{c-its: {{kubeconfig: {config}}}}}\n"
        )
        asked = ("status", "--state-repo", state.path, "--clusters", clusters)
        with Dialogue(*asked) as talk:
            talk.read_until("asking the clusters, 1 s")
            talk.type(CTRL_C)
            assert talk.end() == 130, talk.text
        assert talk.text.endswith("\ninterrupted\n")
        with Dialogue(*asked, "--request-timeout", "1s") as talk:
            assert talk.end() == 1, talk.text
    assert "warning: cluster 'c-its' cannot be read: it did not answer within 1s\n" in talk.text
    assert "not well: clusters that cannot be read: c-its\n" in talk.text
