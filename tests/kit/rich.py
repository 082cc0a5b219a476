"""A valid configuration and valid goals in which every field has a value."""

from __future__ import annotations

from pathlib import Path

from demandops.model.config.appdef import ApplicationDefinition, ServiceDefinition
from demandops.model.config.inventory import BrokersFile, ClustersFile, NodesFile
from demandops.model.config.override import OverrideFile
from demandops.model.config.policy import AccessDomainsFile
from demandops.model.config.registry import ChartsFile, ClientsFile, ImagesFile, VersionsFile
from demandops.model.config.repo_settings import RepoSettings
from demandops.model.demand.goals import DemandGoal, WireGoal
from pydantic import BaseModel

from tests.kit import plain_yaml
from tests.kit.config import configuration, texts_below
from tests.kit.goals import CLOUD, EGO, Goal, application, connection, goal

APPDEF = "appdefs/object-detection-fusion/appdef.yaml"
CONFIG_MODELS: dict[str, type[BaseModel]] = {
    "demandops.yaml": RepoSettings,
    "inventory/brokers.yaml": BrokersFile,
    "inventory/clusters.yaml": ClustersFile,
    "inventory/nodes.yaml": NodesFile,
    "policy/access-domains.yaml": AccessDomainsFile,
    "registry/charts.yaml": ChartsFile,
    "registry/images.yaml": ImagesFile,
    "registry/clients.yaml": ClientsFile,
    "registry/versions.yaml": VersionsFile,
    APPDEF: ApplicationDefinition,
    "appdefs/lidar-driver/service.yaml": ServiceDefinition,
    "overrides/values.yaml": OverrideFile,
}
GOAL_MODELS: tuple[type[BaseModel], ...] = (WireGoal, DemandGoal)
_FOLDER = Path(__file__).parents[1] / "fixtures" / "rich"


def rich() -> dict[str, str]:
    """Return the files of a valid configuration with every field except ``proposals.api``."""
    files = configuration(texts_below(_FOLDER / "state-repo"))
    charts = "appdefs/object-detection-fusion/charts"
    chart = files[f"{charts}/object-detection/Chart.yaml"]
    files[f"{charts}/object-detection-next/Chart.yaml"] = chart.replace("0.1.0", "0.3.0", 1)
    return files


def rich_with_api() -> dict[str, str]:
    """Return the files of :func:`rich`, but for Argo CD and with ``proposals.api``."""
    return rich() | {"demandops.yaml": texts_below(_FOLDER)["proposals-by-api.yaml"]}


def reference_goal() -> Goal:
    """Return a valid goal of the reference's action with every field."""
    topics = [EGO[0], CLOUD[0]]
    made = goal([application(ego=[EGO])], [connection(topics=topics, targets=["/a", "/b"])])
    body = made["apps"][0]["object_detection_fusion_app"]
    body["pointcloud_topics"][0]["type"] = "sensor_msgs/msg/PointCloud2"
    return made


def own_goal() -> Goal:
    """Return a valid demand in our own format with every field."""
    made: Goal = plain_yaml.load(texts_below(_FOLDER)["own-goal.yaml"])
    return made
