"""Quantities of resources, as Kubernetes writes them: ``500m``, ``1.5``, ``16Gi`` or ``16e9``."""

from __future__ import annotations

import re
from fractions import Fraction
from functools import lru_cache

from demandops.base.quoting import quoted

_BINARY = ("Ki", "Mi", "Gi", "Ti", "Pi", "Ei")
_FACTORS = {
    "": Fraction(1),
    **{unit: Fraction(1024) ** power for power, unit in enumerate(_BINARY, 1)},
    **{unit: Fraction(1000) ** power for power, unit in enumerate("num kMGTPE", -3) if unit != " "},
}
_QUANTITY = re.compile(
    r"\+?(?=\.?[0-9])([0-9]{0,19}(?:\.[0-9]{0,9})?)"
    rf"(?:[eE]([+-]?[0-9]{{1,2}})|({'|'.join(filter(None, _FACTORS))})?)"
)


@lru_cache(maxsize=1024)
def amount_of(text: str) -> int:
    """Return a quantity in thousandths; negative ones are refused."""
    match = _QUANTITY.fullmatch(text)
    if match is None:
        raise ValueError(f"{quoted(text)} is not a quantity; write one like 2, 500m, 1.5 or 16Gi")
    number, exponent, unit = match.groups(default="")
    amount = Fraction(number) * _FACTORS[unit] * Fraction(10) ** int(exponent or 0) * 1000
    if amount.denominator > 1:
        raise ValueError(f"{quoted(text)} is finer than a thousandth; round it")
    return amount.numerator


def amount_text(amount: int, resource: str) -> str:  # of thousandths
    if resource.endswith(("memory", "storage")):
        for unit in reversed(_BINARY):
            if amount and amount % (1000 * _FACTORS[unit]) == 0:
                return f"{amount // (1000 * _FACTORS[unit])}{unit}"
    whole, decimals = divmod(amount, 1000)
    return f"{whole}.{decimals:03}".rstrip("0") if decimals else str(whole)
