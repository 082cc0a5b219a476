"""One cluster with Argo CD for all tests."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.e2e.common.expected import CLUSTER, NODES
from tests.e2e.common.world import running
from tests.e2e.rig.cluster import Rig
from tests.e2e.rig.tools import Report


@pytest.fixture(scope="session")
def rig(request: pytest.FixtureRequest, say: Report) -> Iterator[Rig]:
    cluster = Rig(CLUSTER, gitops="argocd", nodes=NODES, report=say)
    with running(cluster, request.session):
        yield cluster
