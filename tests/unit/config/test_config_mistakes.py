"""What people mistype in a state repo, and the message that names file, field and remedy.

Each case is one edit of a file of the skeleton. In an expected message ``{at}`` stands for the line
of the edit, ``{next}`` for the one after it, and ``…`` at the end for a remedy in whatever words.
"""

from __future__ import annotations

import json
from collections.abc import Mapping

import pytest
from demandops.config.load import load
from demandops.errors import InvalidInput

from tests.kit.config import brokers, configuration, edited, skeleton

ROOT = "demandops.yaml"
CLUSTERS = "inventory/clusters.yaml"
NODES = "inventory/nodes.yaml"
BROKERS = "inventory/brokers.yaml"
DOMAINS = "policy/access-domains.yaml"
CHARTS = "registry/charts.yaml"
IMAGES = "registry/images.yaml"
APPDEF = "appdefs/object-detection-fusion/appdef.yaml"
CHART = "appdefs/object-detection-fusion/charts/object-detection"
LABEL = "^[a-z0-9]([-a-z0-9]*[a-z0-9])?$"
NAME = "is not a name that can be used here; it must match"
V1 = "- id: vehicle01\n"
FOLDER = f"    folder: {CHART}\n"


def faults(changed: Mapping[str, str | None]) -> list[str]:
    """Return the faults of a configuration that must be refused."""
    with pytest.raises(InvalidInput) as invalid:
        load(configuration(changed))
    return [str(found) for found in invalid.value.faults]


EDITS: dict[str, tuple[str, str, str, list[str]]] = {
    # what any file can get wrong
    "a colon too many": (
        ROOT, "kind: StateRepository", "kind: State: Repository",
        ["line {at}, column 12: not valid YAML: mapping values are not allowed in this context"],
    ),
    "a tab": (
        CLUSTERS, "  - name: c-its", "\t- name: c-its",
        ["line {at}, column 1: not valid YAML: found character that cannot start any token"],
    ),
    "a key twice": (
        NODES, "    type: vehicle\n", "    type: vehicle\n    type: edge\n",
        ["line {next}, column 5: not valid YAML: the key 'type' appears twice"],
    ),
    "an anchor": (
        NODES, "- id: vehicle00", "- id: &v vehicle00",
        ["line {at}: anchors and aliases (& and *) are not allowed; write the value out"],
    ),
    "two documents": (
        IMAGES, "kind: Images", "---\nkind: Images", ["holds 2 documents; only one is allowed"],
    ),
    "a version that is not known": (
        NODES, "demandops/v1", "demandops/v2",
        ["apiVersion: is 'demandops/v2', but must be 'demandops/v1'"],
    ),
    "no version": (NODES, "apiVersion: demandops/v1\n", "", ["apiVersion: is missing; add it"]),
    "another kind": (NODES, "kind: Nodes", "kind: Node", ["kind: is 'Node', but must be 'Nodes'"]),
    "a field that does not exist": (
        NODES, "nodes:\n  -", "node: []\nnodes:\n  -",
        ["node: is not a field here; remove it or correct its spelling; did you mean 'nodes'?"],
    ),
    "a misspelt field of an item": (
        NODES, "    cluster: c-its\n", "    clutser: c-its\n",
        [
            "nodes[0].cluster: is missing; add it",
            "nodes[0].clutser: is not a field here; remove it or correct its spelling; did you "
            "mean "
            "'cluster'?",
        ],
    ),
    # how nodes reach each other
    "an endpoint that needs certificates": (
        NODES, V1, V1 + "    zenoh: {endpoint: tls/vehicle01:7447}\n",
        [
            f"nodes[1].zenoh.endpoint: 'tls/vehicle01:7447' {NAME} "
            r"^(tcp|udp|ws)/[^\s/#?]+:\d{1,5}$"
        ],
    ),
    "listening where nobody connects": (
        NODES, V1, V1 + '    zenoh: {listen: ["tcp/0.0.0.0:7447"]}\n',
        ["nodes[1].zenoh: listen needs an endpoint, where others reach the node; add it"],
    ),
    "two bridges on one host": (
        NODES, V1,
        "- id: twin\n    type: vehicle\n    cluster: c-its\n    zenoh: {}\n"
        "    selector: {host: a}\n  " + V1 + "    zenoh: {}\n    selector: {host: a}\n",
        [
            "nodes[2].zenoh: 'twin' already runs a bridge on the same host and ROS domain; "
            "remove one of them"
        ],
    ),
    "ports in the wrong order": (
        NODES, V1, V1 + "    wan: {host: 192.0.2.1, firstPort: 3000, lastPort: 2000}\n",
        ["nodes[1].wan: lastPort 2000 is below firstPort 3000; swap them"],
    ),
    "a port that only root may open": (
        NODES, V1, V1 + "    wan: {host: 192.0.2.1, firstPort: 80}\n",
        ["nodes[1].wan.firstPort: input should be greater than or equal to 1024, not 80"],
    ),
    "a message type without its package": (
        NODES, V1, V1 + "    types: {/a: String}\n",
        ["nodes[1].types./a: 'String' is not a message type; write it like std_msgs/msg/String"],
    ),
    "topics that are bridged to a node that does not exist": (
        NODES, V1, V1 + "    bridged: {egde: [/a]}\n",
        ["nodes[1].bridged.egde: 'egde' is not in nodes.yaml; did you mean 'edge'?"],
    ),
    "a password in Git": (
        BROKERS, "    port: 1883\n", "    port: 1883\n    credentials: {secret: a, password: b}\n",
        ["brokers[0].credentials.password: is not a field here; remove it or correct its spelling"],
    ),
    "credentials without the Secret that holds them": (
        BROKERS, "    port: 1883\n", "    port: 1883\n    credentials: {userKey: name}\n",
        ["brokers[0].credentials.secret: is missing; add it"],
    ),
    "a key of a Secret that is a path": (
        BROKERS, "    port: 1883\n", "    port: 1883\n    tls: {caSecret: a, caKey: ../ca.crt}\n",
        [f"brokers[0].tls.caKey: '../ca.crt' {NAME} ^[A-Za-z0-9_][A-Za-z0-9_.-]*$"],
    ),
    # demandops.yaml
    "a controller that is not known": (
        ROOT, "gitops: flux", "gitops: helm",
        ["gitops: is 'helm', but must be 'flux' or 'argocd'"],
    ),
    "a controller without its section": (
        ROOT, "gitops: flux", "gitops: argocd",
        ["argocd: is missing, but gitops is argocd; add it with the url that the clusters fetch "
         "this repo from"],
    ),
    "a newer generator's rendering": (
        ROOT, "renderVersion: 1", "renderVersion: 2",
        ["renderVersion: is 2, but this generator renders version 1; update the generator"],
    ),
    "a rendering that never was": (
        ROOT, "renderVersion: 1", "renderVersion: 0",
        ["renderVersion: input should be greater than or equal to 1, not 0"],
    ),
    "a version as text": (
        ROOT, "renderVersion: 1", 'renderVersion: "1"',
        ["renderVersion: must be a whole number, not '1'"],
    ),
    # inventory/clusters.yaml
    "a cluster twice": (
        CLUSTERS, "  - name: c-its", "  - name: c-its\n  - name: c-its",
        ["clusters[1].name: 'c-its' appears twice; remove one"],
    ),
    "a cluster that is no folder": (
        CLUSTERS, "name: c-its", "name: ../c-its",
        [f"clusters[0].name: '../c-its' {NAME} {LABEL}"],
    ),
    # inventory/nodes.yaml
    "a kind of node that does not exist": (
        NODES, "type: vehicle", "type: car",
        ["nodes[0].type: is 'car', but must be 'vehicle', 'station', 'edge' or 'cloud'"],
    ),
    "a misspelt cluster": (
        NODES, "cluster: c-its", "cluster: c-it",
        ["nodes[0].cluster: 'c-it' is not in clusters.yaml; did you mean 'c-its'?"],
    ),
    "a cluster in capitals": (
        NODES, "cluster: c-its", "cluster: C-ITS", [f"nodes[0].cluster: 'C-ITS' {NAME} {LABEL}"],
    ),
    "a node twice": (
        NODES, "id: vehicle01", "id: vehicle00",
        ["nodes[1].id: 'vehicle00' appears twice; remove one"],
    ),
    "a node that is a number": (
        NODES, "id: vehicle01", "id: 5", ["nodes[1].id: must be text, not 5; put it in quotes"],
    ),
    "a selector's truth that should be text": (
        NODES, V1, f"{V1}    selector: {{ready: yes}}\n",
        ["nodes[1].selector.ready: must be text, not True; put it in quotes"],
    ),
    "a selector's value that is no label": (
        NODES, V1, f"{V1}    selector: {{ready: a b}}\n",
        [
            f"nodes[1].selector.ready: 'a b' {NAME} "
            "^([A-Za-z0-9]([A-Za-z0-9_.-]{0,61}[A-Za-z0-9])?)?$"
        ],
    ),
    "an operator that taints do not have": (
        NODES, V1, f"{V1}    tolerations: [{{key: a, operator: In}}]\n",
        ["nodes[1].tolerations[0].operator: is 'In', but must be 'Exists' or 'Equal'"],
    ),
    "a ROS domain beyond the last": (
        NODES, V1, f"{V1}    ros: {{domainId: 233}}\n",
        ["nodes[1].ros.domainId: input should be less than or equal to 232, not 233"],
    ),
    "a middleware that does not exist": (
        NODES, V1, f"{V1}    ros: {{rmw: rmw_dds}}\n",
        [
            "nodes[1].ros.rmw: is 'rmw_dds', but must be 'rmw_cyclonedds_cpp', "
            "'rmw_fastrtps_cpp', 'rmw_connextdds' or 'rmw_zenoh_cpp'"
        ],
    ),
    "a text for a truth": (
        NODES, V1, f'{V1}    hostNetwork: "yes"\n',
        ["nodes[1].hostNetwork: must be true or false, not 'yes'"],
    ),
    # inventory/brokers.yaml
    "a misspelt node of a broker": (
        BROKERS, "node: cloud", "node: clod",
        ["brokers[0].node: 'clod' is not in nodes.yaml; did you mean 'cloud'?"],
    ),
    "two brokers on a node": (
        BROKERS, "node: cloud", "node: edge", ["brokers[1].node: 'edge' appears twice; remove one"],
    ),
    "a port beyond the last": (
        BROKERS, "port: 1883", "port: 70000",
        ["brokers[0].port: input should be less than or equal to 65535, not 70000"],
    ),
    "a port as text": (
        BROKERS, "port: 1883", 'port: "1883"',
        ["brokers[0].port: must be a whole number, not '1883'"],
    ),
    "a host that is none": (
        BROKERS, "service-mqtt-broker-cloud", "my broker",
        [f"brokers[0].host: 'my broker' {NAME} ^[A-Za-z0-9]([A-Za-z0-9.:-]*[A-Za-z0-9])?$"],
    ),
    "a broker of another protocol": (
        BROKERS, "- node: cloud", "- type: kafka\n    node: cloud",
        ["brokers[0].type: is 'kafka', but must be 'mqtt'"],
    ),
    # policy/access-domains.yaml
    "a namespace in capitals": (
        DOMAINS, "namespace: perception", "namespace: Perception",
        [f"domains[0].namespace: 'Perception' {NAME} {LABEL}"],
    ),
    "an account that is none": (
        DOMAINS, "serviceAccount: demandops", "serviceAccount: a_b",
        [f"domains[0].serviceAccount: 'a_b' {NAME} {LABEL}"],
    ),
    "two domains in one namespace": (
        DOMAINS, "domains:\n",
        "domains:\n  - name: other\n    namespace: perception\n    nodes: [nobody]\n",
        [
            "domains[1].namespace: 'perception' is already the namespace of 'other'; give each "
            "its own"
        ],
    ),
    "a domain twice": (
        DOMAINS, "domains:\n",
        "domains:\n  - name: perception\n    namespace: other\n    nodes: [nobody]\n",
        ["domains[1].name: 'perception' appears twice; remove one"],
    ),
    # registry/charts.yaml
    "a chart's folder that does not exist": (
        CHARTS, CHART, f"{CHART}s",
        [
            f"charts.object-detection.folder: '{CHART}s/Chart.yaml' does not exist; correct the "
            f"folder"
        ],
    ),
    "a chart outside": (
        CHARTS, CHART, "appdefs/../../x",
        ["charts.object-detection: folder must stay inside the state repo; remove '..'"],
    ),
    "a chart's version that is not the folder's": (
        CHARTS, "version: 0.1.0", "version: 0.1.1",
        [
            f"charts.object-detection.version: is 0.1.1, but {CHART}/Chart.yaml says 0.1.0; make "
            f"them equal"
        ],
    ),
    "a chart's version that is none": (
        CHARTS, "version: 0.1.0", "version: latest",
        [
            f"charts.object-detection.version: 'latest' {NAME} "
            r"^\d+\.\d+\.\d+(-[0-9A-Za-z.-]+)?$"
        ],
    ),
    "a chart's version that YAML takes for a number": (
        CHARTS, "version: 0.1.0", "version: 0.1",
        ["charts.object-detection.version: must be text, not 0.1; put it in quotes"],
    ),
    "a chart from two places": (
        CHARTS, FOLDER, f"{FOLDER}    oci: oci://ghcr.io/x\n",
        [
            "charts.object-detection: needs exactly one of folder, oci and http, not folder and "
            "oci"
        ],
    ),
    "a chart from nowhere": (
        CHARTS, FOLDER, "",
        ["charts.object-detection: needs exactly one of folder, oci and http"],
    ),
    "a chart's address with a password": (
        CHARTS, FOLDER, "    http: https://me:secret@charts.example.org\n",
        [
            "charts.object-detection: must not contain a user or password; give them to the GitOps "
            "controller as a Secret"
        ],
    ),
    "an OCI address that is none": (
        CHARTS, FOLDER, "    oci: https://ghcr.io/x\n",
        [rf"charts.object-detection.oci: 'https://ghcr.io/x' {NAME} ^oci://[^\s]+$"],
    ),
    # registry/images.yaml
    "an image that is not pinned": (
        IMAGES, "    tag: 2025-04\n", "",
        ["images.object-detection: needs a tag or a digest; without one the image is not pinned"],
    ),
    "a digest cut short": (
        IMAGES, "tag: 2025-04", "digest: sha256:abc",
        [f"images.object-detection.digest: 'sha256:abc' {NAME} ^sha256:[0-9a-f]{{64}}$"],
    ),
    "a repository in capitals": (
        IMAGES, "docker.io/rwthika/robotkube-object-detection", "Docker.io/X",
        [f"images.object-detection.repository: 'Docker.io/X' {NAME} ^[a-z0-9][a-z0-9._/:-]*$"],
    ),
    "a tag that YAML takes for a number": (
        IMAGES, "tag: 2025-04", "tag: 2025",
        ["images.object-detection.tag: must be text, not 2025; put it in quotes"],
    ),
    "an MQTT client that is missing": (
        IMAGES, "  mqtt-client:", "  mqtt-clint:",
        ["images: 'mqtt-client' is missing; add it, because MQTT connections run it"],
    ),
    # appdefs/*/appdef.yaml
    "an input that does not exist": (
        APPDEF, "each: point_cloud", "each: point_clod",
        ["services.object-detection.each: 'point_clod' is not an input; did you mean "
         "'point_cloud'?"],
    ),
    "both each and inputs": (
        APPDEF, "each: point_cloud\n", "each: point_cloud\n    inputs: {ego_data: ego_data}\n",
        [
            "services.object-detection: 'each' already names the service's input; remove 'inputs'"
        ],
    ),
    "a source for an application": (
        APPDEF, "prefix: of\n", "prefix: of\n    placement: source\n",
        [
            "services.object-fusion: placement 'source' needs 'each': an application has no "
            "single source"
        ],
    ),
    "an output that does not exist": (
        APPDEF, "object-detection.object_list", "object-detection.objects",
        [
            "services.object-fusion.inputs.object_list: 'object-detection.objects' is neither an "
            "input nor an output of a service that runs for each topic; did you mean "
            "'object-detection.object_list'?"
        ],
    ),
    "a list of the message for an input that does not exist": (
        APPDEF, "ego_data_topics: ego_data", "ego_data_topics: ego",
        ["deploymentRequest.inputs: 'ego' is not an input; known: ego_data, point_cloud"],
    ),
    "a list that the message does not have": (
        APPDEF, "ego_data_topics: ego_data", "ego_topics: ego_data",
        [
            "deploymentRequest.inputs.ego_topics: is 'ego_topics', but must be 'ego_data_topics' "
            "or 'pointcloud_topics'"
        ],
    ),
    "a type that ROS's default takes": (
        APPDEF, "type: 1\n", "type: 0\n",
        ["deploymentRequest.type: input should be greater than or equal to 1, not 0"],
    ),
    "a prefix that connections have": (
        APPDEF, "prefix: of", "prefix: mqtt",
        ["services.object-fusion.prefix: 'mqtt' is the prefix of connections; choose another"],
    ),
    "a prefix of two services": (
        APPDEF, "prefix: of", "prefix: od",
        [
            "services.object-fusion.prefix: 'od' is used by 'object-detection' already; choose "
            "another (only identical services with 'each' may share a prefix)"
        ],
    ),
    "a prefix with a dash": (
        APPDEF, "prefix: of", "prefix: o-f",
        [f"services.object-fusion.prefix: 'o-f' {NAME} ^[a-z][a-z0-9]{{0,9}}$"],
    ),
    "an output that is no topic": (
        APPDEF, "/{instance}_local_objectlist", "objects",
        [
            f"services.object-detection.outputs.object_list: 'objects' {NAME} "
            r"^(/([A-Za-z_][A-Za-z0-9_]*|([A-Za-z_][A-Za-z0-9_]*)?\{instance\}[A-Za-z0-9_]*))+$"
        ],
    ),
    "a chart that is not in the registry": (
        APPDEF, "chart: object-detection", "chart: object-detektion",
        [
            "services.object-detection.chart: 'object-detektion' is not in registry/charts.yaml; "
            "did you mean 'object-detection'?"
        ],
    ),
    "an image that is not in the registry": (
        APPDEF, "images: [object-detection]", "images: [object-detektion]",
        [
            "services.object-detection.images: 'object-detektion' is not in registry/images.yaml; "
            "did you mean 'object-detection'?"
        ],
    ),
    "a template that does not exist": (
        APPDEF, "values/object-detection.yaml.j2", "values/object-detektion.yaml.j2",
        ["services.object-detection.values: 'values/object-detektion.yaml.j2' does not exist; …"],
    ),
    "a template outside": (
        APPDEF, "values/object-detection.yaml.j2", "../x",
        [f"services.object-detection.values: '../x' {NAME} ^values/[A-Za-z0-9_.-]+$"],
    ),
    "bounds the wrong way round": (
        APPDEF, "prefix: of\n", "prefix: of\n    scaling: {min: 3, max: 2}\n",
        [
            "services.object-fusion.scaling: min 3 is above max 2; lower min or raise max"
        ],
    ),
    "no topic for a replica": (
        APPDEF, "prefix: of\n", "prefix: of\n    scaling: {topicsPerReplica: 0}\n",
        [
            "services.object-fusion.scaling.topicsPerReplica: input should be greater than or "
            "equal to 1, not 0"
        ],
    ),
    "a merge that does not exist": (
        APPDEF, "services:\n", "parameters:\n  rate: {merge: avg}\nservices:\n",
        ["parameters.rate.merge: is 'avg', but must be 'union', 'max', 'min' or 'latest'"],
    ),
    "a service in capitals": (
        APPDEF, "  object-detection:\n", "  Object_Detection:\n",
        [f"services.Object_Detection: 'Object_Detection' {NAME} {LABEL}"],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", EDITS)
def test_a_mistake_is_told_with_file_field_and_remedy(name: str) -> None:
    path, old, new, expected = EDITS[name]
    found = faults(edited(path, old, new))
    at = skeleton()[path][: skeleton()[path].index(old)].count("\n") + 1
    expected = [
        message.replace("{at}", str(at)).replace("{next}", str(at + 1)) for message in expected
    ]
    for index, message in enumerate(expected):
        if message.endswith("…") and index < len(found):
            found[index] = found[index][: len(path) + 2 + len(message) - 1] + "…"
    assert found == [f"{path}: {message}" for message in expected]


@pytest.mark.parametrize("path", [ROOT, CLUSTERS, NODES, BROKERS, DOMAINS, CHARTS, IMAGES])
@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "is missing; `demandops init` creates an example"),
        ("", "must be a mapping that starts with apiVersion: demandops/v1"),
        ("- a\n", "must be a mapping that starts with apiVersion: demandops/v1"),
        ("a: [\n", "line 2, column 1: not valid YAML: did not find expected node content"),
    ],
    ids=["missing", "empty", "a list", "no YAML"],
)
def test_a_file_that_holds_nothing_of_use(path: str, content: str | None, message: str) -> None:
    assert faults({path: content}) == [f"{path}: {message}"]


class TestArgoCd:
    """What is asked of a state repo that Argo CD reads."""

    @staticmethod
    def root(**section: object) -> dict[str, str | None]:
        text = skeleton("argocd")[ROOT]
        url = "  url: https://git.example/fleet/state-repo.git\n"
        assert url in text
        return {ROOT: text.replace(url, f"  {json.dumps(section)}\n")}

    def test_a_url_is_enough(self) -> None:
        config = load(configuration(self.root(url="https://git.example/state.git")))
        assert config.repo_settings.argocd
        assert config.repo_settings.argocd.namespace == "argocd"

    def test_the_other_controllers_section_may_stay(self) -> None:
        text = skeleton()[ROOT] + "argocd:\n  url: https://git.example/state.git\n"
        assert load(configuration({ROOT: text})).repo_settings.gitops == "flux"

    def test_a_section_without_its_url(self) -> None:
        assert faults(self.root(namespace="argo")) == [f"{ROOT}: argocd.url: is missing; add it"]

    def test_a_field_of_fluxs(self) -> None:
        found = faults(self.root(url="https://git.example/state.git", interval="1m"))
        assert found == [
            f"{ROOT}: argocd.interval: is not a field here; remove it or correct its spelling"
        ]

    def test_a_domain_in_argo_cds_own_namespace(self) -> None:
        root = self.root(url="https://git.example/state.git", namespace="perception")
        assert faults(root) == [
            f"{DOMAINS}: domains[0].namespace: 'perception' is Argo CD's own namespace, where an "
            f"Application may do all that Argo CD may; choose another"
        ]


class TestNodes:
    """Ids are the field's own and may be nearly any text; what cannot work is told in time."""

    @pytest.mark.parametrize(
        ("id", "message"),
        [
            ("", "is empty; give an id"),
            ("../x", "'../x' holds '..'; choose an id without it"),
            (r"a\nb", r"'a\nb' holds the control character U+000A; choose an id without it"),
            (
                r"a\u202eb",
                r"'a\u202eb' holds the control character U+202E; choose an id without it",
            ),
        ],
    )
    def test_an_id_that_no_demand_could_name_is_refused(self, id: str, message: str) -> None:
        """A demand that names it is refused for its id, so such a node is of no use."""
        change = edited(NODES, V1, f'- id: "{id}"\n    selector: {{a: b}}\n')
        assert faults(change) == [f"{NODES}: nodes[1].id: {message}"]

    @pytest.mark.parametrize("id", ["vehicle/01", "vehicle 01", "é", "x" * 64, "-a"])
    def test_an_id_that_is_no_label_needs_a_selector(self, id: str) -> None:
        """Without one, ``node_id: <id>`` would be written, which the API server refuses."""
        (found,) = faults(edited(NODES, V1, f'- id: "{id}"\n'))
        assert found.startswith(f"{NODES}: nodes[1]")
        assert "selector" in found
        load(configuration(edited(NODES, V1, f'- id: "{id}"\n    selector: {{a: b}}\n')))

    @pytest.mark.parametrize("topic", ["ego", "x y", "~/ego", "/a//b", "/é"])
    def test_a_usual_topic_that_ros_forbids_is_refused(self, topic: str) -> None:
        (found,) = faults(edited(NODES, "/vehicles/vehicle00/ego_data", f'"{topic}"'))
        assert found.startswith(f"{NODES}: nodes[0].topics.ego_data: ")

    def test_a_usual_topic_for_an_input_of_no_application_is_refused(self) -> None:
        """It would never be found, and the releases be named in another way than meant."""
        (found,) = faults(edited(NODES, "ego_data: /", "ego_date: /"))
        assert found.startswith(f"{NODES}: nodes[0].topics.ego_date: ")
        assert found.endswith("; did you mean 'ego_data'?")

    def test_a_toleration_that_kubernetes_refuses_is_refused(self) -> None:
        taint = "{key: a, operator: Exists, value: b}"
        (found,) = faults(edited(NODES, V1, f"{V1}    tolerations: [{taint}]\n"))
        assert found.startswith(f"{NODES}: nodes[1].tolerations[0]")

    @pytest.mark.parametrize(
        ("field", "name", "meant"),
        [
            ("ros: {domain_id: 3}", "nodes[1].ros.domain_id", "domainId"),
            ("host_network: false", "nodes[1].host_network", "hostNetwork"),
            ("image_pull_secrets: [x]", "nodes[1].image_pull_secrets", "imagePullSecrets"),
        ],
    )
    def test_a_field_under_the_programs_own_name_is_not_a_field(
        self, field: str, name: str, meant: str
    ) -> None:
        (found,) = faults(edited(NODES, V1, f"{V1}    {field}\n"))
        message = f"{NODES}: {name}: is not a field here; remove it or correct its spelling"
        assert found in (message, f"{message}; did you mean '{meant}'?")

    def test_every_node_of_an_unknown_cluster_is_told(self) -> None:
        change = {CLUSTERS: "apiVersion: demandops/v1\nkind: Clusters\nclusters: [{name: west}]\n"}
        assert faults(change) == [
            f"{NODES}: nodes[{index}].cluster: 'c-its' is not in clusters.yaml; known: west"
            for index in range(7)
        ]

    def test_a_node_in_two_access_domains_is_told(self) -> None:
        other = 'domains:\n  - name: other\n    namespace: other\n    nodes: ["*0"]\n'
        remedy = "narrow their patterns so that it is in one"
        assert faults(edited(DOMAINS, "domains:\n", other)) == [
            f"{NODES}: nodes[{index}].id: '{node}' is in the access domains 'other' and "
            f"'perception'; {remedy}"
            for index, node in ((0, "vehicle00"), (4, "station00"))
        ]


class TestAppdefs:
    """A definition is checked before anybody demands it."""

    def test_a_name_that_is_not_the_folders_is_one_fault(self) -> None:
        assert faults(edited(APPDEF, "name: object-detection-fusion", "name: fusion")) == [
            f"{APPDEF}: name: is 'fusion', but the folder is 'object-detection-fusion'; make "
            f"them equal"
        ]

    def test_an_output_with_letters_that_ros_forbids_is_refused(self) -> None:
        (found,) = faults(edited(APPDEF, "/{instance}_local_objectlist", "/{instance}_ä"))
        assert found.startswith(
            f"{APPDEF}: services.object-detection.outputs.object_list: '/{{inst"
        )

    def test_two_definitions_for_one_type_are_told(self) -> None:
        copy = {
            path.replace("object-detection-fusion/", "copy/", 1): text
            for path, text in skeleton().items()
            if path.startswith("appdefs/object-detection-fusion/") and "/charts/" not in path
        }
        name = "appdefs/copy/appdef.yaml"
        copy[name] = copy[name].replace("name: object-detection-fusion", "name: copy")
        found = faults(copy)
        assert found[-1] == (
            f"{APPDEF}: deploymentRequest.type: 1 already names 'copy'; choose another number"
        )
        assert found[0] == (
            f"{APPDEF}: services.object-fusion.prefix: 'of' is used by 'object-fusion' already; "
            f"choose another (only identical services with 'each' may share a prefix)"
        )

    def test_a_shared_service_with_two_templates_is_told(self) -> None:
        """One release can have one template only; which would it be?"""
        copy = {
            path.replace("object-detection-fusion/", "copy/", 1): text
            for path, text in skeleton().items()
            if path.startswith("appdefs/object-detection-fusion/") and "/charts/" not in path
        }
        name = "appdefs/copy/appdef.yaml"
        copy[name] = (
            copy[name]
            .replace("name: object-detection-fusion", "name: copy")
            .replace("type: 1\n", "type: 2\n")
            .replace("prefix: of", "prefix: cp")
            .replace("object-fusion:\n", "copy-fusion:\n")
        )
        load(configuration(copy))
        copy["appdefs/copy/values/object-detection.yaml.j2"] += "replicas: 5\n"
        found = faults(copy)
        assert any("object-detection" in message for message in found)

    def test_a_chart_without_metadata_is_told(self) -> None:
        path = f"{CHART}/Chart.yaml"
        assert faults({path: "version: [\n"}) == [
            f"{path}: line 2, column 1: not valid YAML: did not find expected node content"
        ]


class TestAllTogether:
    """All faults of all files, so that a person mends them in one go."""

    def test_faults_of_several_files(self) -> None:
        change = {
            **edited(CLUSTERS, "name: c-its", "name: C_ITS"),
            **edited(BROKERS, "port: 1883", "port: 0"),
            **edited(IMAGES, "tag: 2025-04", "tag: 2025"),
            **edited(APPDEF, "prefix: of", "prefix: o-f"),
            CHARTS: None,
        }
        found = faults(change)
        assert {message.split(": ")[0] for message in found} == set(change)

    def test_several_faults_of_one_file(self) -> None:
        text = skeleton()[NODES].replace("type: vehicle", "type: car").replace("id: edge", "id: 5")
        assert faults({NODES: text}) == [
            *(
                f"{NODES}: nodes[{index}].type: is 'car', but must be 'vehicle', 'station', 'edge' "
                "or 'cloud'"
                for index in range(4)
            ),
            f"{NODES}: nodes[5].id: must be text, not 5; put it in quotes",
        ]

    def test_a_fault_of_form_hides_no_fault_of_meaning_in_the_same_file(self) -> None:
        text = skeleton()[NODES].replace("type: vehicle", "type: car", 1)
        text = "c-it".join(text.rsplit("c-its", 1))
        assert faults({NODES: text}) == [
            f"{NODES}: nodes[0].type: is 'car', but must be 'vehicle', 'station', 'edge' or "
            "'cloud'",
            f"{NODES}: nodes[6].cluster: 'c-it' is not in clusters.yaml; did you mean 'c-its'?",
        ]

    def test_a_broken_file_hides_no_fault_of_meaning_in_another(self) -> None:
        change = {
            **edited(IMAGES, "tag: 2025-04", "tag: 2025"),
            **edited(BROKERS, "node: cloud", "node: clod"),
        }
        assert sorted(faults(change)) == [
            f"{BROKERS}: brokers[0].node: 'clod' is not in nodes.yaml; did you mean 'cloud'?",
            f"{IMAGES}: images.object-detection.tag: must be text, not 2025; put it in quotes",
        ]

    def test_a_broken_appdef_hides_no_fault_of_another_file(self) -> None:
        change = {
            **edited(APPDEF, "prefix: of", "prefix: o-f"),
            **edited(BROKERS, "node: cloud", "node: clod"),
        }
        assert [message.split(": ")[0] for message in faults(change)] == [APPDEF, BROKERS]


def test_what_is_odd_but_works() -> None:
    load(configuration(brokers()))
    load(configuration(edited(NODES, V1, f'{V1}    selector: {{"a.b/c": "1e3", d: ""}}\n')))
    load(configuration(edited(NODES, V1, f"{V1}    tolerations: [{{operator: Exists}}]\n")))
    load(configuration(edited(DOMAINS, '"*"', '"*", "ghost"')))
    load(configuration({"README.md": "x", "appdefs/notes.txt": "x", "inventory/README.md": "x"}))
