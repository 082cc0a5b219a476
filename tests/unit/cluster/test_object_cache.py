"""The cache reads a cluster's objects over real HTTP: which calls it makes, and what it reports."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from demandops.cluster.clusters_file import ClusterAccess
from demandops.cluster.health import ObjectSelector
from demandops.cluster.object_cache import ObjectCache

from tests.kit.http import Answer, Call, kubeconfig, serving

OVER = ObjectSelector("Application", "argocd", "demandops-perception")
CHILDREN = ObjectSelector("Application", "perception")
DEPLOYMENTS = ObjectSelector("Deployment", "perception")


@dataclass
class Api:
    """An API server with an Application in each namespace; it records the paths of calls."""

    reached: ClusterAccess
    asked: list[str] = field(default_factory=list)
    refused: str = "nothing"


@pytest.fixture
def api(tmp_path: Path) -> Iterator[Api]:
    def answer(call: Call) -> Answer:
        api.asked.append(call.path)
        item = {"metadata": {"name": "one", "resourceVersion": "1"}}
        listed = {"metadata": {"resourceVersion": "1"}, "items": [item]}
        return Answer.json(listed, 403 if api.refused in call.path else 200)

    with serving(answer) as server:
        api = Api(ClusterAccess(kubeconfig=kubeconfig(tmp_path, server.url)))
        yield api


def store(api: Api) -> ObjectCache:
    return ObjectCache("c-its", api.reached, lambda: None)


def test_one_object_is_asked_for_by_its_name(api: Api) -> None:
    read = store(api)
    assert read.pods("perception", "mqtt-edge") == [], "of a Deployment that is not known"
    read.read_once([OVER, CHILDREN])
    over, children = api.asked
    assert over.endswith(
        "/namespaces/argocd/applications?fieldSelector=metadata.name%3Ddemandops-perception"
    )
    assert children.endswith("/namespaces/perception/applications")
    found = {("Application", namespace, "one") for namespace in ("argocd", "perception")}
    assert set(read.objects()) == found


def test_what_may_not_be_read_is_told_and_the_rest_is_known(api: Api) -> None:
    api.refused = "/argocd/"
    read = store(api)
    read.read_once([OVER, CHILDREN])
    assert read.why_unknown([OVER]) == "applications in argocd: Forbidden"
    assert read.why_unknown([CHILDREN]) == ""
    assert read.why_unknown([DEPLOYMENTS]) == "some objects have not been read yet"


def test_a_cluster_that_is_away_is_asked_once(tmp_path: Path) -> None:
    away = ClusterAccess(kubeconfig=kubeconfig(tmp_path, "http://127.0.0.1:1"))
    read = ObjectCache("away", away, lambda: None)
    read.read_once([OVER, CHILDREN])
    assert read.why_unknown([OVER]).startswith("MaxRetryError")
    assert read.why_unknown([CHILDREN]) == read.why_unknown([OVER])
