"""Files below ``clusters/`` are valid and name no requesters; each domain has its own folder."""

from __future__ import annotations

from collections.abc import Iterator
from operator import itemgetter
from typing import Any

import kubernetes_validate
import pytest
import yaml
from demandops.repo.merge_check.rendered_charts import manifest_faults

from tests.golden.cases import CASES, rendered
from tests.kit import plain_yaml
from tests.kit.goals import application, connection, goal, perception
from tests.kit.memory import MemoryRepo
from tests.kit.plain_yaml import FAST
from tests.unit.model.test_config_mistakes import changed

DOMAINS = {"fleet", "city"}
BUILT_IN = {"v1", "apps/v1", "rbac.authorization.k8s.io/v1"}


def documents(books: MemoryRepo) -> Iterator[tuple[str, dict[str, Any]]]:
    for path, text in books.files.items():
        if path.startswith("clusters/") and path.endswith(".yaml"):
            for document in yaml.load_all(text, Loader=FAST):
                yield path, document


def test_what_is_rendered_fits_the_schemas_of_kubernetes() -> None:
    steps = [files.items() for case in CASES for files in rendered(case).values()]
    manifests = {file for files in steps for file in files if file[0].startswith("clusters/")}
    for path, text in manifests:
        for document in yaml.load_all(text, Loader=FAST):
            if document["apiVersion"] in BUILT_IN:
                kubernetes_validate.validate(document, "1.36", strict=True)
            else:
                assert document["metadata"]["namespace"] == "perception", path


def test_requesters_appear_nowhere_below_clusters() -> None:
    books = MemoryRepo()
    names = ["Requester-Zero", "requester/one", "request \u00fcber {{ two }}"]
    for id, who in (("a-request-of-somebody", names[:2]), ("another one", names[2:])):
        books.send(goal([application(who=who)], [connection(who=who)], id=id))
    demands = [claim.demand for claim in books.state.ledger]
    for path, document in documents(books):
        text = f"{path}\n{yaml.safe_dump(document, allow_unicode=True)}".lower()
        for name in (*names, *demands, "a-request-of", "another one", "requester"):
            assert name.lower() not in text, path


def test_each_access_domain_has_its_own_folder_namespace_and_account() -> None:
    named = {f"namespace: {it}": f"namespace: ns-{it}, serviceAccount: sa-{it}" for it in DOMAINS}
    books = MemoryRepo(changed({"base": "two domains", "policy/access-domains.yaml": named}))
    books.send(perception())
    for path, document in documents(books):
        domain = path.split("/")[2]
        assert document["metadata"]["namespace"] == f"ns-{domain}"
        account = document.get("spec", {}).get("serviceAccountName", f"sa-{domain}")
        assert account == f"sa-{domain}"
    assert {path.split("/")[2] for path, _ in documents(books)} == DOMAINS


@pytest.mark.parametrize("case", plain_yaml.beside(__file__), ids=itemgetter("is"))
def test_the_check_finds_what_kubernetes_would_refuse(case: dict[str, Any]) -> None:
    found = [[fault.file, fault.field] for fault in manifest_faults(case["files"])]
    assert found == case["faults"]
