"""Mistakes that people make in the configuration of a state repo.

``tests/unit/messages`` has the message for each case of ``MISTAKES``. ``test_mistakes_anywhere``
tries every mistake that a JSON schema can find.
"""

from __future__ import annotations

import json
from collections.abc import Mapping

import pytest
from demandops.base.errors import Fault, InvalidInput
from demandops.model.config.load import load

from tests.kit.config import brokers, configuration, edited, skeleton

ROOT = "demandops.yaml"
CLUSTERS = "inventory/clusters.yaml"
NODES = "inventory/nodes.yaml"
BROKERS = "inventory/brokers.yaml"
DOMAINS = "policy/access-domains.yaml"
CHARTS = "registry/charts.yaml"
IMAGES = "registry/images.yaml"
VERSIONS = "registry/versions.yaml"
APPDEF = "appdefs/object-detection-fusion/appdef.yaml"
CHART = "appdefs/object-detection-fusion/charts/object-detection"
V1 = "- id: vehicle01\n"
_FUSION = "    prefix: of\n"
FOLDER = f"    folder: {CHART}\n"


def refused(changed: Mapping[str, str | None]) -> tuple[Fault, ...]:
    """Return the faults of a configuration that must be refused."""
    with pytest.raises(InvalidInput) as invalid:
        load(configuration(changed))
    return invalid.value.faults


def argocd(**section: object) -> dict[str, str]:
    """Return a ``demandops.yaml`` for Argo CD whose section ``argocd`` has these fields."""
    text = skeleton("argocd")[ROOT]
    url = "  url: https://git.example/fleet/state-repo.git\n"
    assert url in text
    return {ROOT: text.replace(url, f"  {json.dumps(section)}\n")}


def second_definition(*edits: tuple[str, str]) -> dict[str, str]:
    """Return the files of ``appdefs/copy``: the skeleton's application definition, with edits."""
    copy = {
        path.replace("object-detection-fusion/", "copy/", 1): text
        for path, text in skeleton().items()
        if path.startswith("appdefs/object-detection-fusion/") and "/charts/" not in path
    }
    for old, new in edits:
        copy["appdefs/copy/appdef.yaml"] = copy["appdefs/copy/appdef.yaml"].replace(old, new)
    return copy


def versions(default: str, listed: Mapping[str, object], **more: object) -> dict[str, str]:
    """Return a ``registry/versions.yaml`` for the skeleton's application definition."""
    entry = {"default": default, "versions": listed, **more}
    applications = {"object-detection-fusion": entry}
    head = {"apiVersion": "demandops/v1", "kind": "Versions"}
    return {VERSIONS: json.dumps(head | {"applications": applications})}


URL = "https://git.example/state.git"
TWICE = second_definition(
    ("name: object-detection-fusion", "name: copy"),
    ("type: 1\n", "type: 2\n"),
    ("prefix: of", "prefix: cp"),
    ("object-fusion:\n", "copy-fusion:\n"),
)
"""A second application definition that also defines the detection service of the first one."""
SERVICE = "appdefs/driver/service.yaml"


def shared(
    *edits: tuple[str, str],
    uses: str = "{cloud: point_cloud}",
    more: Mapping[str, str] | None = None,
) -> dict[str, str]:
    """Return the files of a shared service, and of the application definition that uses it.

    ``edits`` replace texts in the definition of the service. ``more`` are further files.
    """
    definition = """
apiVersion: demandops/v1
kind: ServiceDefinition
name: driver
scope: topic
prefix: drv
inputs: {cloud: {}}
each: cloud
placement: source
outputs: {points: "/{instance}/points"}
chart: object-detection
values: values/driver.yaml.j2
"""
    for old, new in edits:
        assert old in definition
        definition = definition.replace(old, new)
    return {
        **edited(APPDEF, "services:\n", f"uses:\n  driver: {uses}\nservices:\n"),
        SERVICE: definition,
        "appdefs/driver/values/driver.yaml.j2": "{}\n",
        **(more or {}),
    }


_EDITS: dict[str, tuple[str, str, str]] = {
    # mistakes in any file
    "a colon too many": (ROOT, "kind: StateRepository", "kind: State: Repository"),
    "a tab": (CLUSTERS, "  - name: c-its", "\t- name: c-its"),
    "a key twice": (NODES, "    type: vehicle\n", "    type: vehicle\n    type: edge\n"),
    "an anchor": (NODES, "- id: vehicle00", "- id: &v vehicle00"),
    "two documents": (IMAGES, "kind: Images", "---\nkind: Images"),
    "no version": (NODES, "apiVersion: demandops/v1\n", ""),
    "another kind": (NODES, "kind: Nodes", "kind: Node"),
    "a field that does not exist": (NODES, "nodes:\n  -", "node: []\nnodes:\n  -"),
    "a misspelt field of an item": (NODES, "    cluster: c-its\n", "    clutser: c-its\n"),
    # how nodes reach each other
    "an endpoint that needs certificates": (
        NODES, V1, V1 + "    zenoh: {endpoint: tls/vehicle01:7447}\n",
    ),
    "listening without an endpoint": (
        NODES, V1, V1 + '    zenoh: {listen: ["tcp/0.0.0.0:7447"]}\n',
    ),
    "two bridges on one host": (
        NODES, V1, "- id: twin\n    type: vehicle\n    cluster: c-its\n    zenoh: {}\n"
        "    selector: {host: a}\n  " + V1 + "    zenoh: {}\n    selector: {host: a}\n",
    ),
    "ports in the wrong order": (
        NODES, V1, V1 + "    wan: {host: 192.0.2.1, firstPort: 3000, lastPort: 2000}\n",
    ),
    "a position off the map": (NODES, V1, V1 + "    position: {x: 1.0e+9}\n"),
    "a role of two words": (NODES, "type: station", "type: road station"),
    "a message type without its package": (NODES, V1, V1 + "    types: {/a: String}\n"),
    "topics that are bridged to a node that does not exist": (
        NODES, V1, V1 + "    bridged: {egde: [/a]}\n",
    ),
    "a password in Git": (
        BROKERS, "    port: 1883\n", "    port: 1883\n    credentials: {secret: a, password: b}\n",
    ),
    # demandops.yaml
    "a controller without its section": (ROOT, "gitops: flux", "gitops: argocd"),
    "a newer generator's rendering": (ROOT, "renderVersion: 2", "renderVersion: 3"),
    # inventory/clusters.yaml
    "a cluster twice": (CLUSTERS, "  - name: c-its", "  - name: c-its\n  - name: c-its"),
    "a cluster that is no folder": (CLUSTERS, "name: c-its", "name: ../c-its"),
    # inventory/nodes.yaml
    "a misspelt cluster": (NODES, "cluster: c-its", "cluster: c-it"),
    "a cluster in capitals": (NODES, "cluster: c-its", "cluster: C-ITS"),
    "a node twice": (NODES, "id: vehicle01", "id: vehicle00"),
    "a node that is a number": (NODES, "id: vehicle01", "id: 5"),
    "text instead of true or false": (NODES, V1, f'{V1}    hostNetwork: "yes"\n'),
    # inventory/brokers.yaml
    "a misspelt node of a broker": (BROKERS, "node: cloud", "node: clod"),
    "two brokers on a node": (BROKERS, "node: cloud", "node: edge"),
    "a port as text": (BROKERS, "port: 1883", 'port: "1883"'),
    # policy/access-domains.yaml
    "two domains in one namespace": (
        DOMAINS,
        "domains:\n",
        "domains:\n  - name: other\n    namespace: perception\n    nodes: [nobody]\n",
    ),
    "a domain twice": (
        DOMAINS,
        "domains:\n",
        "domains:\n  - name: perception\n    namespace: other\n    nodes: [nobody]\n",
    ),
    # registry/charts.yaml
    "a chart's folder that does not exist": (CHARTS, CHART, f"{CHART}s"),
    "a chart outside": (CHARTS, CHART, "appdefs/../../x"),
    "a chart's version that is not the folder's": (CHARTS, "version: 0.1.0", "version: 0.1.1"),
    "a chart from two places": (CHARTS, FOLDER, f"{FOLDER}    oci: oci://ghcr.io/x\n"),
    "a chart from nowhere": (CHARTS, FOLDER, ""),
    "a chart's address with a password": (
        CHARTS, FOLDER, "    http: https://me:secret@charts.example.org\n",
    ),
    # registry/images.yaml
    "an image that is not pinned": (IMAGES, "    tag: 2025-04\n", ""),
    "an MQTT client that is missing": (IMAGES, "  mqtt-client:", "  mqtt-clint:"),
    # appdefs/*/appdef.yaml
    "an input that does not exist": (APPDEF, "each: point_cloud", "each: point_clod"),
    "an input of other topics than each": (
        APPDEF, "each: point_cloud\n", "each: point_cloud\n    inputs: {ego_data: ego_data}\n",
    ),
    "each topic of an output that is made once": (
        APPDEF,
        "services:\n",
        "services:\n  planner:\n    prefix: pl\n    each: lists\n"
        "    inputs: {lists: object-fusion.fused_objects}\n"
        "    chart: object-fusion\n    values: values/object-fusion.yaml.j2\n",
    ),
    "services in a circle": (
        APPDEF,
        "each: point_cloud\n",
        "each: point_cloud\n    inputs: {all: object-fusion.raw_objects}\n",
    ),
    "an input from a service that does not exist": (
        APPDEF, "object-detection.object_list", "object-detektion.object_list",
    ),
    "a shared service that does not exist": (
        APPDEF, "services:\n", "uses:\n  lidar-driver: {cloud: point_cloud}\nservices:\n",
    ),
    "a node for a service at its sources": (
        APPDEF,
        "prefix: od\n",
        "prefix: od\n    placement: source\n    place: {}\n",
    ),
    "a source for an application": (APPDEF, "prefix: of\n", "prefix: of\n    placement: source\n"),
    "an output that does not exist": (
        APPDEF, "object-detection.object_list", "object-detection.objects",
    ),
    "a list of the message for an input that does not exist": (
        APPDEF, "ego_data_topics: ego_data", "ego_data_topics: ego",
    ),
    "a prefix that connections have": (APPDEF, "prefix: of", "prefix: mqtt"),
    "a prefix of two services": (APPDEF, "prefix: of", "prefix: od"),
    "a chart that is not in the registry": (
        APPDEF, "chart: object-detection", "chart: object-detektion",
    ),
    "an image that is not in the registry": (
        APPDEF, "images: [object-detection]", "images: [object-detektion]",
    ),
    "a template that does not exist": (
        APPDEF, "values/object-detection.yaml.j2", "values/object-detektion.yaml.j2",
    ),
    "a template outside": (APPDEF, "values/object-detection.yaml.j2", "../x"),
    "a node in two access domains": (
        DOMAINS,
        "domains:\n",
        'domains:\n  - name: other\n    namespace: other\n    nodes: ["*0"]\n',
    ),
    "a usual topic for an input of no application": (NODES, "ego_data: /", "ego_date: /"),
    "a toleration that Kubernetes refuses": (
        NODES, V1, f"{V1}    tolerations: [{{key: a, operator: Exists, value: b}}]\n",
    ),
    "an appdef that is not named like its folder": (
        APPDEF, "name: object-detection-fusion", "name: fusion",
    ),
    "an output with letters that ROS forbids": (
        APPDEF, "/{instance}_local_objectlist", "/{instance}_ä",
    ),
    "a node's id: empty": (
        NODES, V1, '- id: ""\n    selector: {a: b}\n',
    ),
    "a node's id: climbs out of a folder": (
        NODES, V1, '- id: "../x"\n    selector: {a: b}\n',
    ),
    "a node's id: a line break": (
        NODES, V1, '- id: "a\\nb"\n    selector: {a: b}\n',
    ),
    "a node's id: reversed text": (
        NODES, V1, '- id: "a\\u202eb"\n    selector: {a: b}\n',
    ),
}  # fmt: skip

_SCALING: dict[str, str] = {
    "bounds the wrong way round": "{min: 3, max: 2}",
    "replicas by the former name": "{min: 1, max: 4, topicsPerReplica: 8}",
    "replicas by an unknown measure": "{max: 4, per: {topic: 8}}",
    "replicas by two measures": "{max: 4, per: {topics: 8, sources: 2}}",
    "replicas without a choice": "{per: {topics: 8}}",
    "replicas by requesters that are not to be seen": "{max: 4, per: {requesters: 8}}",
    "requesters that nothing depends on": "{mayDependOnRequesters: true}",
    "two that decide the replicas": "{max: 4, per: {topics: 8}, autoscaler: {cpu: 70}}",
    "a size by a parameter that does not exist": "{sizes: {parameter: sise, replicas: {s: 1}}}",
    "sizes with bounds": "{max: 4, sizes: {parameter: size, replicas: {s: 1}}}",
    "a size that the default is not": "{sizes: {parameter: size, replicas: {small: 1, l: 0}}}",
    "the largest of words": "{sizes: {parameter: rate, replicas: {s: 1}}}",
    "an autoscaler without a target": "{max: 4, autoscaler: {}}",
    "an autoscaler of none": "{min: 0, max: 4, autoscaler: {cpu: 70}}",
    "replicas that publish twice": "{min: 2, max: 2}",
    "an autoscaler of a service that publishes": "{max: 4, autoscaler: {cpu: 70}}",
}
"""Values of ``scaling`` that are refused for a service that publishes a topic."""


def scaled(scaling: str) -> Mapping[str, str | None]:
    """Return the application definition with two parameters, and ``scaling`` for the fusion."""
    parameters = "parameters: {size: {default: s}, rate: {default: s, merge: max}}\nservices:\n"
    text = edited(APPDEF, "services:\n", parameters)[APPDEF]
    return {APPDEF: text.replace("prefix: of\n", f"prefix: of\n    scaling: {scaling}\n")}


MISTAKES: dict[str, Mapping[str, str | None]] = {
    **{name: edited(*edit) for name, edit in _EDITS.items()},
    **{name: scaled(scaling) for name, scaling in _SCALING.items()},
    "a size of a shared service by a parameter that does not exist": shared(
        ("scope", "scaling: {sizes: {parameter: size, replicas: {s: 1}}}\nscope")
    ),
    "properties of two types, and a service that asks for another": edited(
        NODES,
        V1,
        "- {id: new, type: edge, cluster: c-its, properties: {ros: 2}}\n"
        f"  {V1}    properties: {{memoryGiB: 8, ros: jazzy}}\n",
    )
    | edited(APPDEF, _FUSION, f"{_FUSION}    place: {{properties: {{memoryGiB: a, ros: yes}}}}\n"),
    "values that no property can have": edited(
        NODES, V1, f"{V1}    properties: {{ros: [jazzy], memory GiB: 8, ram: .inf, os: ''}}\n"
    ),
    "bounds that nothing meets": edited(
        APPDEF,
        _FUSION,
        f"{_FUSION}    place:\n"
        "      properties: {a: {min: 8, max: 7}, b: {least: 1}, c: {min: x}}\n",
    ),
    # mistakes at several places or in several files
    "a chart without metadata": {f"{CHART}/Chart.yaml": "version: [\n"},
    "every node of an unknown cluster": {
        CLUSTERS: "apiVersion: demandops/v1\nkind: Clusters\nclusters: [{name: west}]\n"
    },
    "several faults of one file": {
        NODES: skeleton()[NODES]
        .replace("type: vehicle", "type: A Car")
        .replace("id: edge", "id: 5")
    },
    "a fault of form and one of meaning in a file": {
        NODES: "c-it".join(
            skeleton()[NODES].replace("type: vehicle", "type: A Car", 1).rsplit("c-its", 1)
        )
    },
    "a fault of form in one file and one of meaning in another": edited(
        IMAGES, "tag: 2025-04", "tag: 2025"
    )
    | edited(BROKERS, "node: cloud", "node: clod"),
    "a broken appdef and a fault of meaning": edited(APPDEF, "prefix: of", "prefix: o-f")
    | edited(BROKERS, "node: cloud", "node: clod"),
    "faults of many files": {
        **edited(CLUSTERS, "name: c-its", "name: C_ITS"),
        **edited(BROKERS, "port: 1883", "port: 0"),
        **edited(IMAGES, "tag: 2025-04", "tag: 2025"),
        **edited(APPDEF, "prefix: of", "prefix: o-f"),
        CHARTS: None,
    },
    "Argo CD's section without its url": argocd(namespace="argo"),
    "a field of Flux's in Argo CD's section": argocd(url=URL, interval="1m"),
    "a domain in Argo CD's own namespace": argocd(url=URL, namespace="perception"),
    "two definitions for one type": second_definition(
        ("name: object-detection-fusion", "name: copy")
    ),
    "a service in two definitions": TWICE,
    "an application without services": {
        "appdefs/copy/appdef.yaml": "apiVersion: demandops/v1\nkind: ApplicationDefinition\n"
        "name: copy\ninputs: {cloud: {}}\n"
    },
    "a shared service that the application defines too": shared(
        more=edited(APPDEF, "services:\n", "uses:\n  object-fusion: {}\nservices:\n")
    ),
    "an input of a shared service that nobody names": shared(uses="{}"),
    "an input that the shared service does not have": shared(
        uses="{cloud: point_cloud, ego: ego_data}"
    ),
    "a shared service for each topic of nothing": shared(("each: cloud\n", "")),
    "a shared service for each topic of an unknown input": shared(("each: cloud", "each: clouds")),
    "a shared service at the source of an application": shared(
        ("each: cloud\n", ""), ("scope: topic", "scope: application")
    ),
    "a shared service on a node that it chooses": shared(
        ("scope: topic\n", "scope: node\nplace: {role: edge}\n"), ("each: cloud\n", "")
    ),
    "a shared service for a cluster": shared(("scope: topic", "scope: cluster")),
    "a shared service at the sources of nothing": shared(
        ("each: cloud\n", ""),
        ("scope: topic", "scope: node"),
        uses="{cloud: object-fusion.raw_objects}",
    ),
    "a service at the source that reads what several nodes make": shared(
        ("inputs: {cloud: {}}", "inputs: {cloud: {}, lists: {}}"),
        uses="{cloud: point_cloud, lists: object-detection.object_list}",
    ),
    "a shared service with the prefix of another": shared(("prefix: drv", "prefix: od")),
    "a shared service without its template": shared(("values/driver", "values/drive")),
    "a shared service that is not named like its folder": shared(("name: driver", "name: drive")),
    "a shared service for topics of two inputs": shared(
        more={
            "appdefs/copy/appdef.yaml": """
apiVersion: demandops/v1
kind: ApplicationDefinition
name: copy
inputs: {cloud: {}}
uses:
  driver: {cloud: cloud}
"""
        }
    ),
    "an order of versions that nobody wrote down": edited(
        APPDEF, "inputs:\n", "versions: update\ninputs:\n"
    ),
    "a policy that does not exist": edited(APPDEF, "inputs:\n", "versions: patch\ninputs:\n"),
    "a default and a channel that are not listed": versions(
        "1.0.1", {"1.0.0": {}}, channels={"next": "1.1.0"}
    ),
    "a version that is none": versions("1.0", {"1.0": {}}),
    "versions of an application that does not exist": {
        VERSIONS: versions("1.0.0", {"1.0.0": {}})[VERSIONS].replace("fusion", "fuison")
    },
    "what no service has, and a chart in a version that does not exist": versions(
        "1.1.0",
        {
            "1.1.0": {
                "charts": {"object-fuson": "0.2.0", "object-fusion": "0.2.0"},
                "images": {"mqtt-client": {"tag": "v"}},
            }
        },
    ),
}
"""By the name of a mistake: the files that differ from the skeleton. Each mistake is refused."""


@pytest.mark.parametrize("content", [None, "", "- a\n", "a: [\n"])
def test_a_file_of_no_use_is_one_fault(content: str | None) -> None:
    for path in (ROOT, CLUSTERS, NODES, BROKERS, DOMAINS, CHARTS, IMAGES):
        (found,) = refused({path: content})
        assert found.file == path


@pytest.mark.parametrize("id", ["vehicle/01", "vehicle 01", "é", "x" * 64, "-a"])
def test_an_id_that_is_no_label_needs_a_selector(id: str) -> None:
    """Without a selector, a release selects ``node_id: <id>``, which must be a valid label."""
    (found,) = refused(edited(NODES, V1, f'- id: "{id}"\n'))
    assert found.file == NODES
    assert "selector" in str(found)
    load(configuration(edited(NODES, V1, f'- id: "{id}"\n    selector: {{a: b}}\n')))


@pytest.mark.parametrize("topic", ["ego", "x y", "~/ego", "/a//b", "/é"])
def test_a_usual_topic_that_ros_forbids_is_refused(topic: str) -> None:
    (found,) = refused(edited(NODES, "/vehicles/vehicle00/ego_data", f'"{topic}"'))
    assert (found.file, found.field) == (NODES, "nodes[0].topics.ego_data")


@pytest.mark.parametrize(
    "changed",
    [
        brokers(),
        edited(NODES, V1, f'{V1}    selector: {{"a.b/c": "1e3", d: ""}}\n'),
        edited(NODES, V1, f"{V1}    tolerations: [{{operator: Exists}}]\n"),
        edited(DOMAINS, '"*"', '"*", "ghost"'),
        {"README.md": "x", "appdefs/notes.txt": "x", "inventory/README.md": "x"},
        argocd(url=URL),
        {ROOT: f"{skeleton()[ROOT]}argocd:\n  url: {URL}\n"},
        shared(),
        shared(("each: cloud\n", ""), ("scope: topic", "scope: node")),
        versions("1.0.0", {"1.0.0": {}, "2.0.0-rc.1": {"charts": {"object-fusion": "0.1.0"}}}),
    ],
)
def test_an_odd_but_valid_configuration_loads(changed: dict[str, str]) -> None:
    load(configuration(changed))
