"""A valid configuration and valid goals in which every field has a value."""

from __future__ import annotations

from typing import Any

from demandops.model.config.appdef import ApplicationDefinition, ServiceDefinition
from demandops.model.config.inventory import BrokersFile, ClustersFile, NodesFile
from demandops.model.config.override import OverrideFile
from demandops.model.config.policy import AccessDomainsFile
from demandops.model.config.registry import ChartsFile, ClientsFile, ImagesFile, VersionsFile
from demandops.model.config.repo_settings import RepoSettings
from demandops.model.demand.demand_goal import DemandGoal
from demandops.model.demand.deployment_request_goal import WireGoal
from pydantic import BaseModel

from tests.kit import plain_yaml
from tests.kit.config import configuration, override
from tests.kit.goals import CLOUD, EGO, Goal, application, connection, goal

APPDEF = "appdefs/object-detection-fusion/appdef.yaml"
SERVICE = "appdefs/lidar-driver/service.yaml"
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
    SERVICE: ServiceDefinition,
    "overrides/values.yaml": OverrideFile,
}
GOAL_MODELS: tuple[type[BaseModel], ...] = (WireGoal, DemandGoal)
_FOLDER = "appdefs/object-detection-fusion/charts"
_DIGEST = "sha256:" + "0" * 64

_ROOT = """
apiVersion: demandops/v1
kind: StateRepository
gitops: flux
renderVersion: 2
source: demandops
flux: {url: "https://git.example/fleet/state.git", interval: 1m, secret: git}
argocd: {url: "https://git.example/fleet/state.git", namespace: argocd}
proposals: {forge: gitlab, url: "https://git.example/fleet/state", labels: [demand]}
limits:
  demandCharacters: 800000
  demandItems: 400
  parameterBytes: 90000
  fileBytes: 900000
  decisionMilliseconds: 400
placement: spread
"""
_PROPOSALS_BY_API = """
apiVersion: demandops/v1
kind: StateRepository
gitops: argocd
renderVersion: 2
argocd: {url: "https://git.example/fleet/state.git", namespace: argocd}
proposals: {forge: gitea, url: "https://git.example/fleet/state", api: "https://git.example/api/v1"}
"""
_CLUSTERS = """
apiVersion: demandops/v1
kind: Clusters
clusters:
  - {name: c-its, description: All nodes}
  - {name: depot, description: A second cluster}
"""
_NODES = """
apiVersion: demandops/v1
kind: Nodes
nodes:
  - id: vehicle00
    type: vehicle
    cluster: c-its
    selector: {example.org/host: first}
    topics: {ego_data: /vehicles/vehicle00/ego_data}
    tolerations:
      - {key: road, operator: Equal, value: wet, effect: NoSchedule}
      - {operator: Exists}
    imagePullSecrets: [registry]
    hostNetwork: false
    ros: {domainId: 3, rmw: rmw_zenoh_cpp}
    zenoh: {endpoint: "tcp/v0:7447", listen: ["tcp/0.0.0.0:7447"], connect: ["udp/router:7447"]}
    wan: {host: 192.0.2.1, firstPort: 20000, lastPort: 20099, transport: udp}
    types: {/vehicles/vehicle00/ego_data: perception_msgs/msg/EgoData}
    bridged: {edge: [/clock]}
    capabilities: [lidar]
    properties: {memoryGiB: 7.5, ros: jazzy, heated: true}
    position: {x: 12.5, y: -3.0}
    drained: false
    capacity: {cpu: "8", memory: 16Gi, example.org/gpu: "1"}
  - id: edge
    type: edge
    cluster: c-its
    capabilities: [gpu]
    properties: {memoryGiB: 32, ros: jazzy}
    accessDomains:
      - {name: backend, zenoh: {endpoint: "tcp/edge:7448"}, wan: {host: 192.0.2.2}}
  - {id: cloud, type: cloud, cluster: depot, properties: {memoryGiB: 64, ros: jazzy}}
"""
_BROKERS = """
apiVersion: demandops/v1
kind: Brokers
brokers:
  - node: edge
    type: mqtt
    host: broker-edge
    port: 8883
    tls: {caSecret: ca, caKey: ca.crt}
    credentials: {secret: login, userKey: user, passwordKey: password}
    topicPrefix: fleet/one
"""
_DOMAINS = """
apiVersion: demandops/v1
kind: AccessDomains
domains:
  - name: perception
    namespace: perception
    serviceAccount: demandops
    nodes: ["vehicle*", edge]
    rules:
      - name: all
        requesters: ["*"]
        applications: ["*"]
        nodes: ["*"]
        brokers: ["*"]
        peers: [back*]
        approval: none
    quotas: {claimsPerRequester: 50, servicesPerNode: 60, demandsPerMinute: 70}
    leases: {default: 1h, longest: 2h, slack: 20s, deploymentRequests: true}
    network: namespace
    approval: none
    whenFull: wait
    podSecurity: privileged
    ros: {domainId: 7}
    brokerCredentials:
      edge: {secret: of-domain, userKey: u, passwordKey: p}
    kinds:
      - ConfigMap
      - Deployment
      - Secret
      - {kind: ServiceMonitor, group: monitoring.coreos.com, resource: servicemonitors}
  - name: backend
    namespace: backend
    nodes: [cloud]
    rules: [{name: all, nodes: [cloud], peers: ["*"]}]
"""
_CHARTS = f"""
apiVersion: demandops/v1
kind: Charts
charts:
  object-detection:
    folder: {_FOLDER}/object-detection
    version: 0.1.0
    channels:
      next: {{oci: "oci://registry.example/charts/od", version: 0.2.0}}
      old: {{http: "https://charts.example", version: 0.0.9}}
      other: {{folder: {_FOLDER}/object-detection-next, version: 0.3.0}}
  object-fusion: {{folder: {_FOLDER}/object-fusion, version: 0.1.0}}
  by-oci: {{oci: "oci://registry.example/charts/x", version: 1.0.0}}
  by-http: {{http: "https://charts.example", version: 1.0.0}}
"""
_IMAGES = "apiVersion: demandops/v1\nkind: Images\nregistry: mirror:5000\nimages:\n" + "".join(
    f"  {name}: {{repository: registry.example/{name}, tag: v1, digest: '{_DIGEST}'}}\n"
    for name in (
        *("object-detection", "object-fusion", "k8s-configmap-watcher"),
        *("mqtt-client", "zenoh-bridge", "dds-router"),
    )
)
_CLIENT = """
  env: {ROS_STATIC_PEERS: 192.0.2.1}
  resources: {requests: {cpu: 100m}, limits: {memory: 1Gi}}
  hostNetwork: false
  startupProbe: {exec: {command: ["true"]}}
  readinessProbe: {exec: {command: ["true"]}}
  livenessProbe: {exec: {command: ["true"]}}
"""
_CLIENTS = f"""
apiVersion: demandops/v1
kind: Clients
mqtt:{_CLIENT}
  launchFile: own.launch.xml
  rmw: rmw_fastrtps_cpp
  messages: [std_msgs, sensor_msgs, perception_msgs]
zenoh:{_CLIENT}
ros:{_CLIENT}"""
_VERSIONS = f"""
apiVersion: demandops/v1
kind: Versions
applications:
  object-detection-fusion:
    default: 1.0.0
    channels: {{next: 1.1.0}}
    versions:
      1.0.0: {{}}
      1.1.0:
        charts: {{object-detection: 0.2.0}}
        images:
          object-detection: {{repository: mirror.example/od, tag: v2, digest: '{_DIGEST}'}}
"""
_APPDEF = """
apiVersion: demandops/v1
kind: ApplicationDefinition
name: object-detection-fusion
description: Detects and fuses
approval: none
versions: update
inputs:
  ego_data: {description: State of a vehicle, type: perception_msgs/msg/EgoData}
  point_cloud: {description: Lidar points, type: sensor_msgs/msg/PointCloud2}
parameters:
  rate: {description: Highest rate in Hz, default: 10, merge: max}
  size: {description: How many there are, default: small, merge: union}
deploymentRequest:
  type: 1
  inputs: {ego_data_topics: ego_data, pointcloud_topics: point_cloud}
uses:
  lidar-driver: {cloud: point_cloud}
services:
  object-detection:
    prefix: od
    description: Detects objects
    each: point_cloud
    outputs: {object_list: "/{instance}_objects"}
    placement: application
    scaling: {max: 3, autoscaler: {cpu: 70, memory: 80}, dividesWork: true}
    requests: {cpu: 250m, memory: 1Gi, example.org/gpu: "1"}
    chart: object-detection
    images: [object-detection]
    values: values/object-detection.yaml.j2
  object-fusion:
    prefix: of
    inputs: {ego_data: ego_data, object_list: object-detection.object_list}
    outputs:
      raw_objects: "/{instance}_raw"
      fused_objects: "/{instance}_fused"
      fused_trajectories: "/{instance}_trajectories"
    scaling:
      {min: 1, max: 4, per: {requesters: 2}, mayDependOnRequesters: true, dividesWork: true}
    chart: object-fusion
    images: [object-fusion, k8s-configmap-watcher]
    values: values/object-fusion.yaml.j2
  object-tracking:
    prefix: ot
    place:
      role: edge
      labels: {node_id: edge}
      capabilities: [gpu]
      properties: {memoryGiB: {min: 8, max: 64}, ros: jazzy}
    inputs: {ego_data: ego_data, object_list: object-detection.object_list}
    outputs:
      raw_objects: "/{instance}_untracked"
      fused_objects: "/{instance}_tracked"
      fused_trajectories: "/{instance}_tracks"
    scaling: {sizes: {parameter: size, replicas: {none: 0, small: 1}}}
    chart: object-fusion
    images: [object-fusion, k8s-configmap-watcher]
    values: values/object-fusion.yaml.j2
"""
_SERVICE = """
apiVersion: demandops/v1
kind: ServiceDefinition
name: lidar-driver
description: Publishes points
scope: topic
prefix: drv
inputs:
  cloud: {description: Lidar points, type: sensor_msgs/msg/PointCloud2}
each: cloud
placement: source
outputs: {points: "/{instance}_points"}
parameters:
  rate: {description: Highest rate in Hz, default: 10, merge: max}
scaling: {min: 1, max: 4, per: {topics: 2}, dividesWork: true, downAfter: 10m}
requests: {cpu: 100m}
chart: by-oci
images: [object-detection]
values: values/lidar-driver.yaml.j2
"""
_OVERRIDES = {
    "values": override(
        {"services": ["object-d*"], "appdefs": ["*"], "applications": ["edge/*"], "nodes": ["e*"]},
        {"services": ["object-detection"], "labels": {"node_id": "edge"}},
        priority=3,
        expires="2027-01-31T12:00:00Z",
        values={"podLabels": {"a": "b"}},
        version="next",
        images={
            "object-detection": {"repository": "mirror.example/od", "tag": "v2", "digest": _DIGEST}
        },
        replicas=2,
        node="edge",
    ),
    "hold": override({"services": ["object-fusion"], "requesters": ["*"]}, hold=True),
    "deny": override({"connections": ["c*"]}, deny=True),
    "keep": override({"applications": ["main"]}, keep=True),
}


def rich() -> dict[str, str]:
    """Return the files of a valid configuration with every field except ``proposals.api``."""
    files = configuration(
        {
            "demandops.yaml": _ROOT,
            "inventory/clusters.yaml": _CLUSTERS,
            "inventory/nodes.yaml": _NODES,
            "inventory/brokers.yaml": _BROKERS,
            "policy/access-domains.yaml": _DOMAINS,
            "registry/charts.yaml": _CHARTS,
            "registry/images.yaml": _IMAGES,
            "registry/clients.yaml": _CLIENTS,
            "registry/versions.yaml": _VERSIONS,
            APPDEF: _APPDEF,
            SERVICE: _SERVICE,
            "appdefs/lidar-driver/values/lidar-driver.yaml.j2": "replicas: {{ replicas }}\n",
        }
        | {f"overrides/{name}.yaml": text for name, text in _OVERRIDES.items()}
    )
    chart = files[f"{_FOLDER}/object-detection/Chart.yaml"]
    files[f"{_FOLDER}/object-detection-next/Chart.yaml"] = chart.replace(
        "version: 0.1.0", "version: 0.3.0"
    )
    return files


def rich_with_api() -> dict[str, str]:
    """Return the files of :func:`rich` with another ``demandops.yaml``.

    It is for Argo CD, has ``proposals.api``, and lacks most optional fields.
    """
    return rich() | {"demandops.yaml": _PROPOSALS_BY_API}


def reference_goal() -> Goal:
    """Return a valid goal of the reference's action with every field."""
    topics = [EGO[0], CLOUD[0]]
    made = goal([application(ego=[EGO])], [connection(topics=topics, targets=["/a", "/b"])])
    body = made["apps"][0]["object_detection_fusion_app"]
    body["pointcloud_topics"][0]["type"] = "sensor_msgs/msg/PointCloud2"
    return made


def own_goal() -> Goal:
    """Return a valid demand in our own format with every field."""
    text = """
apiVersion: demandops/v1
kind: Demand
operation: put
demand: patrol
request: patrol-1
requesters: [vehicle00]
lease: 10m
answer: pushed
priority: 3
positions:
  - {node: edge, x: 1.5, y: 2.0}
applications:
  - id: main
    type: object-detection-fusion
    node: edge
    version: next
    connect: none
    inputs:
      ego_data:
        - {topic: /ego, source: vehicle00, type: perception_msgs/msg/EgoData}
    parameters: {rate: 5}
    deliver:
      - {output: object-fusion.raw_objects, node: vehicle00, topic: /raw}
  - id: second
    type: object-detection-fusion
    place:
      role: edge
      labels: [node_id=edge]
      capabilities: [gpu]
      properties: ["memoryGiB>=8", ros=jazzy]
    services: {object-fusion: cloud}
    inputs: {point_cloud: [{topic: /points, source: vehicle00}]}
    parameters_json: {rate: "7"}
connections:
  - id: link
    type: mqtt
    source: vehicle00
    target: edge
    broker: edge
    topics:
      - {source: /a, target: /b, type: std_msgs/msg/String, reverse: false, qos: 1, retained: true,
         primitive: true, reliability: reliable, durability: volatile, queue: 5, rate: 0}
"""
    made: dict[str, Any] = plain_yaml.load(text)
    return made
