"""The requester hears what came of it with Argo CD."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.e2e.common.access import access_file, documented_roles, limited
from tests.e2e.common.answers import TIMEOUT_S, Answers, restarted
from tests.e2e.common.ros import Client
from tests.e2e.rig.cluster import Rig

from .conftest import CLUSTER
from .world import World


@pytest.fixture(scope="module")
def world(
    rig: Rig, client: Client, ros_domain: int, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[World]:
    """With the rights that docs/status.md asks for."""
    made = World(rig, tmp_path_factory.mktemp("world"), ros_domain, client)
    try:
        made.bootstrap(CLUSTER)
        rights = documented_roles("argo cd")
        kubeconfig = limited(rig.kube, rig.kubeconfig, made.folder, rights)
        access_file(made.folder, CLUSTER, kubeconfig=kubeconfig)
        restarted(made, TIMEOUT_S)
        yield made
    finally:
        made.remove()


class TestArgoCD(Answers):
    """What is particular to Argo CD."""

    def mended(self, world: Any) -> None:
        """A chart in a folder is looked at every few minutes, or when somebody asks for it."""
        world.domain.refresh("od-edge-vehicle00")
