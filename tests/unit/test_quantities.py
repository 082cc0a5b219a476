"""Quantities of resources are read as Kubernetes reads them."""

from __future__ import annotations

import pytest
from demandops.base.quantities import amount_of, amount_text

from tests.kit import plain_yaml

TABLES = plain_yaml.beside(__file__)


@pytest.mark.parametrize(("text", "thousandths", "of_cpu", "of_memory"), TABLES["quantities"])
def test_a_quantity_is_read_as_kubernetes_does(
    text: str, thousandths: int, of_cpu: str, of_memory: str
) -> None:
    assert amount_of(text) == thousandths
    assert amount_text(thousandths, "cpu") == of_cpu
    assert amount_text(thousandths, "memory") == of_memory


@pytest.mark.parametrize("text", TABLES["invalid"])
def test_an_invalid_quantity_is_a_fault(text: str) -> None:
    with pytest.raises(ValueError, match=r"is not a quantity|is finer than a thousandth"):
        amount_of(text)
