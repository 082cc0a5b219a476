"""The requester learns with Argo CD whether its services run."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.e2e.common.access import access_file, documented_roles, limited
from tests.e2e.common.answers import TIMEOUT_S, Answers, restart_generator
from tests.e2e.common.ros import Client
from tests.e2e.rig.cluster import Rig

from .conftest import CLUSTER
from .world import World


@pytest.fixture(scope="module")
def world(
    rig: Rig, client: Client, ros_domain: int, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[World]:
    """A state repo whose generator has the rights that docs/status.md requires."""
    made = World(rig, tmp_path_factory.mktemp("world"), ros_domain, client)
    try:
        made.bootstrap(CLUSTER)
        rights = documented_roles("argo cd")
        kubeconfig = limited(rig.kube, rig.kubeconfig, made.folder, rights)
        access_file(made.folder, CLUSTER, kubeconfig=kubeconfig)
        restart_generator(made, TIMEOUT_S)
        yield made
    finally:
        made.remove()


class TestArgoCD(Answers):
    """The tests with Argo CD."""

    def read_repaired_chart(self, world: Any) -> None:
        """Argo CD reads a chart folder only every few minutes, or on request."""
        world.domain.refresh("od-edge-vehicle00")
