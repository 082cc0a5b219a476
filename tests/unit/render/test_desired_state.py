"""What stands below ``clusters/``: valid, without requesters, and touched only where it must be."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import kubernetes_validate
import pytest
import yaml
from demandops.errors import InvalidInput
from demandops.render.output_check import check_files

from tests.kit.config import FAST, edited
from tests.kit.goals import CLOUD, EGO, STATION_CLOUD, application, connection, goal, perception
from tests.kit.golden import CASES, rendered
from tests.kit.memory import MemoryRepo

BUILT_IN = {"v1", "apps/v1", "rbac.authorization.k8s.io/v1"}


def documents(books: MemoryRepo) -> Iterator[tuple[str, dict[str, Any]]]:
    for path, text in books.files.items():
        if path.startswith("clusters/") and path.endswith(".yaml"):
            for document in yaml.load_all(text, Loader=FAST):
                yield path, document


@pytest.mark.parametrize("case", CASES)
def test_what_is_rendered_fits_the_schemas_of_kubernetes(case: str) -> None:
    seen: set[tuple[str, str]] = set()
    for files in rendered(case).values():
        manifests = {path: text for path, text in files.items() if path.startswith("clusters/")}
        check_files(manifests)
        for path, text in manifests.items() - seen:
            for document in yaml.load_all(text, Loader=FAST):
                if document["apiVersion"] in BUILT_IN:
                    kubernetes_validate.validate(document, "1.36", strict=True)
                else:
                    assert document["metadata"]["namespace"] == "perception", path
        seen |= manifests.items()


def test_requesters_appear_nowhere_below_clusters() -> None:
    books = MemoryRepo()
    names = ["Requester-Zero", "requester/one", "request \u00fcber {{ two }}"]
    books.send(
        goal([application(who=names[:2])], [connection(who=names[:2])], id="a-request-of-somebody")
    )
    books.send(goal([application(who=names[2:])], [connection(who=names[2:])], id="another one"))
    for path, document in documents(books):
        text = f"{path}\n{yaml.safe_dump(document, allow_unicode=True)}".lower()
        for name in (*names, "a-request-of", "another one", "requester-zero", "requester"):
            assert name.lower() not in text, path
        for claim in books.state.ledger:
            assert claim.demand not in text


def test_a_further_requester_changes_no_file_below_clusters() -> None:
    books = MemoryRepo()
    books.send(perception())
    further = books.send(
        goal([application(who=["vehicle01"])], [connection(who=["vehicle01"])], id="further")
    )
    assert further.outcome == "booked"
    assert [path.split("/")[0] for path in further.files] == ["ledger", "ledger"]
    assert further.releases == ()
    gone = books.send(
        goal(
            [application(who=["vehicle01"])],
            [connection(who=["vehicle01"])],
            id="further",
            shutdown=True,
        )
    )
    assert {path.split("/")[0] for path in gone.files} == {"ledger"}
    assert gone.releases == ()


def test_a_demand_touches_only_what_it_changes() -> None:
    books = MemoryRepo()
    for number in range(10):
        books.send(goal([], [connection(f"c{number}")], id=f"r{number}"))
    books.send(goal([application(clouds=[STATION_CLOUD])], id="first"))
    decision = books.send(goal([application(clouds=[CLOUD], ego=[EGO])], id="second"))
    changed = sorted(path.rsplit("/", 1)[1] for path in decision.files if "clusters/" in path)
    assert len(changed) == 2
    assert changed[0] == "od-edge-vehicle00.yaml"
    assert changed[1].startswith("of-")


def test_the_inputs_of_a_fusion_change_nothing_but_the_inputs() -> None:
    """They reach a ConfigMap through the chart; everything else of the values restarts pods."""
    books = MemoryRepo()
    books.send(goal([application(clouds=[STATION_CLOUD])], id="1"))
    before = fusion(books)
    books.send(goal([application(clouds=[CLOUD], ego=[EGO])], id="2"))
    after = fusion(books)
    assert after["spec"]["values"].pop("inputs") == {
        "egoData": [EGO[0]],
        "objectList": ["/station00_local_objectlist", "/vehicle00_local_objectlist"],
    }
    assert before["spec"]["values"].pop("inputs") == {
        "egoData": [],
        "objectList": ["/station00_local_objectlist"],
    }
    assert before == after


def fusion(books: MemoryRepo) -> dict[str, Any]:
    (found,) = (
        item for name, item in books.objects("HelmRelease").items() if name.startswith("of-")
    )
    return found


def test_each_access_domain_has_its_own_folder_namespace_and_account() -> None:
    text = "apiVersion: demandops/v1\nkind: AccessDomains\ndomains:\n"
    for name in ("fleet", "city"):
        text += f"  - {{name: {name}, namespace: ns-{name}, serviceAccount: sa-{name}, nodes: ["
        text += '"vehicle*"]}\n' if name == "fleet" else "edge, cloud, station00]}\n"
    books = MemoryRepo({"policy/access-domains.yaml": text})
    books.send(perception())
    for path, document in documents(books):
        domain = path.split("/")[2]
        assert document["metadata"]["namespace"] == f"ns-{domain}"
        account = document.get("spec", {}).get("serviceAccountName", f"sa-{domain}")
        assert account == f"sa-{domain}"
    folders = {path.split("/")[2] for path, _ in documents(books)}
    assert folders == {"fleet", "city"}


class TestLastLook:
    """Before a commit: nothing invalid, nothing twice, nothing outside the generator's folders."""

    CONFIG = "apiVersion: v1\nkind: ConfigMap\nmetadata: {name: a, namespace: b}\n"

    @staticmethod
    def faults(files: dict[str, str | None]) -> list[str]:
        with pytest.raises(InvalidInput) as invalid:
            check_files(files)
        return [str(found) for found in invalid.value.faults]

    @pytest.mark.parametrize(
        "path",
        ["inventory/nodes.yaml", "demandops.yaml", "clusters/../x.yaml", "/clusters/x.yaml", "x"],
    )
    def test_a_path_outside_is_refused(self, path: str) -> None:
        assert self.faults({path: None})[0] == f"{path}: is not the generator's to write"

    def test_what_does_not_fit_the_schema_is_refused(self) -> None:
        path = "clusters/c/d/n/x.yaml"
        found = self.faults({path: self.CONFIG + "data: {a: 1}\nfoo: bar\n"})
        assert {message.split(": ")[0] for message in found} == {path}
        assert len(found) == 2

    def test_one_object_in_two_files_is_refused(self) -> None:
        files: dict[str, str | None] = {
            "clusters/c/d/n/x.yaml": self.CONFIG,
            "clusters/c/d/n/y.yaml": self.CONFIG,
        }
        assert self.faults(files) == [
            "clusters/c/d/n/y.yaml: metadata.name: ConfigMap a is in clusters/c/d/n/x.yaml too"
        ]

    def test_one_object_twice_in_a_file_is_refused(self) -> None:
        path = "clusters/c/d/n/x.yaml"
        assert len(self.faults({path: f"{self.CONFIG}---\n{self.CONFIG}"})) == 1

    def test_one_name_on_two_clusters_is_no_clash(self) -> None:
        check_files({f"clusters/{name}/d/n/x.yaml": self.CONFIG for name in ("a", "b")})

    def test_what_is_no_yaml_is_refused(self) -> None:
        assert len(self.faults({"clusters/c/d/n/x.yaml": "a: [\n"})) == 1
        assert len(self.faults({"clusters/c/d/n/x.yaml": "- a\n"})) == 1


def test_a_new_selector_of_a_node_reaches_what_runs_there() -> None:
    change = edited(
        "inventory/nodes.yaml", "- id: edge\n", "- id: edge\n    selector: {rack: r1}\n"
    )
    books = MemoryRepo(change)
    books.send(perception())
    for release in books.objects("HelmRelease").values():
        assert release["spec"]["values"]["nodeSelector"] == {"rack": "r1"}
    selectors = {
        deployment["metadata"]["annotations"]["demandops/node"]: deployment["spec"]["template"][
            "spec"
        ]["nodeSelector"]
        for deployment in books.objects("Deployment").values()
    }
    assert selectors == {"edge": {"rack": "r1"}, "vehicle00": {"node_id": "vehicle00"}}
