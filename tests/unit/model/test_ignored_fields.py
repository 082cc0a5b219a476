"""A field that a definition no longer has is found where it stands, and `upgrade` removes it."""

from __future__ import annotations

import pytest
from demandops.model.config.appdef import ignored_fields, without_ignored_fields

SERVICE = "appdefs/driver/service.yaml"
APPDEF = "appdefs/driver/appdef.yaml"


@pytest.mark.parametrize(
    ("path", "text", "left"),
    [
        (SERVICE, "scaling: {max: 4, downAfter: 10m} # Petra\n", "scaling: {max: 4} # Petra\n"),
        (SERVICE, "scaling: {downAfter: 10m, max: 4}\n", "scaling: {max: 4}\n"),
        (SERVICE, "scaling: {min: 1, downAfter: 1m, max: 4}", "scaling: {min: 1, max: 4}"),
        (SERVICE, "scaling: {max: 4, # many\n  downAfter: 1m}", "scaling: {max: 4, # many\n  }"),
        (SERVICE, "scaling: {downAfter: 10m}\n", "scaling: {}\n"),
        (SERVICE, "scaling:\n  downAfter: 10m # calm\n", "scaling:\n  {} # calm\n"),
        (SERVICE, "scaling:\n  downAfter: 10m\n  max: 4\n", "scaling:\n  max: 4\n"),
        (
            SERVICE,
            "scaling:\r\n  # at night\r\n  max: 4\r\n  downAfter: 10m # calm\r\n# end\r\nname: a",
            "scaling:\r\n  # at night\r\n  max: 4\r\n# end\r\nname: a",
        ),
        (
            APPDEF,
            "services:\n  a:\n    scaling: {max: 4, downAfter: 1m}\n"
            "  b:\n    scaling:\n      max: 2\n      downAfter: 1m\n",
            "services:\n  a:\n    scaling: {max: 4}\n  b:\n    scaling:\n      max: 2\n",
        ),
    ],
)
def test_it_is_removed_and_all_else_stays(path: str, text: str, left: str) -> None:
    assert ignored_fields(path, text)
    assert without_ignored_fields(path, text) == left


@pytest.mark.parametrize(
    ("path", "text"),
    [
        ("appdefs/driver/values/driver.yaml", "scaling: {downAfter: 10m}\n"),
        (SERVICE, "parameters: {downAfter: 10m}\n"),
        (SERVICE, "# scaling: {downAfter: 10m}\n"),
        (SERVICE, "scaling: {downAfter: 10m\n"),
        (SERVICE, "scaling: {downAfter: 10m}\n---\n"),
        (APPDEF, "services: {1: {scaling: {downAfter: 10m}}}\n"),
        (SERVICE, "? scaling\n: ? downAfter\n  : 10m\n  ? max\n  : 4\n"),
    ],
    ids=[
        "another file",
        "another field",
        "a comment",
        "invalid",
        "two documents",
        "no text",
        "an odd form",
    ],
)
def test_what_is_not_meant_or_cannot_be_removed_stays(path: str, text: str) -> None:
    assert without_ignored_fields(path, text) == text
