"""What people mistype in a state repo.

Each case of ``EDITS`` is one edit of a file of the skeleton; ``tests/unit/messages`` holds what is
said of it. ``test_mistakes_anywhere`` tries every mistake that a JSON schema knows.
"""

from __future__ import annotations

import json
from collections.abc import Mapping

import pytest
from demandops.config.load import load
from demandops.errors import Fault, InvalidInput

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
V1 = "- id: vehicle01\n"
FOLDER = f"    folder: {CHART}\n"


def refused(changed: Mapping[str, str | None]) -> tuple[Fault, ...]:
    """Return the faults of a configuration that must be refused."""
    with pytest.raises(InvalidInput) as invalid:
        load(configuration(changed))
    return invalid.value.faults


def faults(changed: Mapping[str, str | None]) -> list[str]:
    """Return the same as text."""
    return [str(found) for found in refused(changed)]


EDITS: dict[str, tuple[str, str, str]] = {
    # what any file can get wrong
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
    "listening where nobody connects": (
        NODES, V1, V1 + '    zenoh: {listen: ["tcp/0.0.0.0:7447"]}\n',
    ),
    "two bridges on one host": (
        NODES, V1, "- id: twin\n    type: vehicle\n    cluster: c-its\n    zenoh: {}\n"
        "    selector: {host: a}\n  " + V1 + "    zenoh: {}\n    selector: {host: a}\n",
    ),
    "ports in the wrong order": (
        NODES, V1, V1 + "    wan: {host: 192.0.2.1, firstPort: 3000, lastPort: 2000}\n",
    ),
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
    "a text for a truth": (NODES, V1, f'{V1}    hostNetwork: "yes"\n'),
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
    "both each and inputs": (
        APPDEF, "each: point_cloud\n", "each: point_cloud\n    inputs: {ego_data: ego_data}\n",
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
    "bounds the wrong way round": (
        APPDEF, "prefix: of\n", "prefix: of\n    scaling: {min: 3, max: 2}\n",
    ),
}  # fmt: skip


@pytest.mark.parametrize("content", [None, "", "- a\n", "a: [\n"])
def test_a_file_of_no_use_is_one_fault(content: str | None) -> None:
    for path in (ROOT, CLUSTERS, NODES, BROKERS, DOMAINS, CHARTS, IMAGES):
        (found,) = refused({path: content})
        assert found.file == path


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
        assert faults({path: "version: [\n"})[0].startswith(
            f"{path}: line 2, column 1: not valid YAML: "
        )


class TestAllTogether:
    """All faults of all files, so that a person fixes them in one go."""

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
