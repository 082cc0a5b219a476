"""The requester hears what came of it with Flux."""

from __future__ import annotations

import pytest

from tests.e2e.common.access import access_file, documented_roles, limited
from tests.e2e.common.answers import TIMEOUT_S, Answers, restarted
from tests.e2e.rig.cluster import Rig

from .conftest import CLUSTER, MakeWorld
from .world import World


@pytest.fixture(scope="module")
def world(make_world: MakeWorld, rig: Rig) -> World:
    """With the rights that docs/status.md asks for."""
    made = make_world()
    made.bootstrap(CLUSTER, rig)
    rights = documented_roles("flux")
    kubeconfig = limited(rig.kube, rig.kubeconfig, made.folder, rights)
    access_file(made.folder, CLUSTER, kubeconfig=kubeconfig)
    restarted(made, TIMEOUT_S)
    return made


class TestFlux(Answers):
    """The tests with Flux."""
