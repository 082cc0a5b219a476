"""The requester learns with Flux whether its services run."""

from __future__ import annotations

import pytest

from tests.e2e.common.access import access_file, documented_roles, limited
from tests.e2e.common.answers import TIMEOUT_S, Answers, restart_generator
from tests.e2e.rig.cluster import Rig

from .conftest import CLUSTER, MakeWorld
from .world import World


@pytest.fixture(scope="module")
def world(make_world: MakeWorld, rig: Rig) -> World:
    """A state repo whose generator has the rights that docs/status.md requires."""
    made = make_world()
    made.bootstrap(CLUSTER, rig)
    rights = documented_roles("flux")
    kubeconfig = limited(rig.kube, rig.kubeconfig, made.folder, rights)
    access_file(made.folder, CLUSTER, kubeconfig=kubeconfig)
    restart_generator(made, TIMEOUT_S)
    return made


class TestFlux(Answers):
    """The tests with Flux."""
