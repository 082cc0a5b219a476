"""Quantities of resources, as Kubernetes writes them: ``500m``, ``1.5`` or ``16Gi``."""

from __future__ import annotations

import re
from functools import lru_cache

from demandops.base.quoting import quoted

_QUANTITY = re.compile(r"([0-9]{1,15})(?:\.([0-9]{1,3}))?(m|k|M|G|T|Ki|Mi|Gi|Ti)?")
_FACTORS = {"m": 1, "": 1000} | {
    unit: 1000 * base**power
    for base, units in ((1000, ("k", "M", "G", "T")), (1024, ("Ki", "Mi", "Gi", "Ti")))
    for power, unit in enumerate(units, 1)
}


@lru_cache(maxsize=1024)
def amount_of(text: str) -> int:
    """Return a quantity in thousandths; exponents and the units above Ti are refused."""
    match = _QUANTITY.fullmatch(text)
    if match is None:
        raise ValueError(f"{quoted(text)} is not a quantity; write one like 2, 500m, 1.5 or 16Gi")
    whole, decimals, unit = match.groups(default="")
    amount, remainder = divmod(int(whole + decimals.ljust(3, "0")) * int(_FACTORS[unit]), 1000)
    if remainder:
        raise ValueError(f"{quoted(text)} is finer than a thousandth; round it")
    return amount


def amount_text(amount: int, resource: str) -> str:  # of thousandths
    if resource.endswith(("memory", "storage")):
        for unit in ("Ti", "Gi", "Mi", "Ki"):
            if amount and amount % _FACTORS[unit] == 0:
                return f"{amount // _FACTORS[unit]}{unit}"
    whole, decimals = divmod(amount, 1000)
    return f"{whole}.{decimals:03}".rstrip("0") if decimals else str(whole)
