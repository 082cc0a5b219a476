"""The errors of the stages: how many faults they list, and what they say of the others."""

from __future__ import annotations

import pytest
from demandops.base.errors import MOST_FAULTS, Fault, InvalidInput
from demandops.base.strict_yaml import located_in
from demandops.model.config.base_model import parse_file
from demandops.model.ledger.records import _KeptReplicasFile


def test_faults_that_are_passed_on_are_still_counted_right() -> None:
    found = InvalidInput(Fault("invalid", f"a{n}", "is wrong") for n in range(MOST_FAULTS + 900))
    with pytest.raises(InvalidInput) as raised, located_in("a: 1\n"):
        raise found
    *listed, last = raised.value.faults
    assert (len(listed), last.message) == (MOST_FAULTS, "has 900 more faults")


def test_a_file_that_is_no_mapping_is_told_the_format_of_its_own_kind() -> None:
    with pytest.raises(InvalidInput, match=r"starts with apiVersion: demandops\.ledger/v2"):
        parse_file(_KeptReplicasFile, "[]", "ledger/replicas/a.yaml")
