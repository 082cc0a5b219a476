"""The parameters of a service, merged from its claims.

The appdef says how several values become one. If it does not, they must agree.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping

from demandops.config.appdef import Parameter
from demandops.demand.claim import Claim
from demandops.errors import Refused, fault


def merged(definitions: Mapping[str, Parameter], claims: Iterable[Claim]) -> dict[str, object]:
    """Return the value of every parameter, merged over all claims.

    Raises:
        Refused: if two claims give values that differ and cannot be merged.
    """
    claims = list(claims)
    values: dict[str, object] = {}
    for name, parameter in sorted(definitions.items()):
        given = [claim for claim in claims if name in claim.application.parameters]
        values[name] = _merged_value(name, parameter, given) if given else parameter.default
    return values


def _merged_value(name: str, parameter: Parameter, claims: list[Claim]) -> object:
    given = [claim.application.parameters[name] for claim in claims]
    if parameter.merge == "latest":
        return max(claims, key=lambda claim: (claim.booked, claim.demand)).application.parameters[
            name
        ]
    if parameter.merge == "union":
        items = [
            item for value in given for item in (value if isinstance(value, list) else [value])
        ]
        unique = {json.dumps(item, sort_keys=True): item for item in items}
        return [unique[key] for key in sorted(unique)]
    if parameter.merge in ("max", "min"):
        numbers = [
            value
            for value in given
            if isinstance(value, int | float) and not isinstance(value, bool)
        ]
        if len(numbers) != len(given):
            odd = next(value for value in given if value not in numbers)
            raise Refused(
                [
                    fault(
                        f"parameters.{name}",
                        f"{odd!r} is not a number, but the application "
                        f"definition takes the {parameter.merge}",
                    )
                ]
            )
        return max(numbers) if parameter.merge == "max" else min(numbers)
    if any(value != given[0] for value in given):
        shown = " and ".join(
            f"{json.dumps(claim.application.parameters[name])} for {', '.join(claim.requesters)}"
            for claim in claims[:3]
        )
        raise Refused(
            [
                fault(
                    f"parameters.{name}",
                    f"demands contradict each other: {shown}; agree, or have "
                    "the application definition say how to merge them",
                    code="conflict",
                )
            ]
        )
    return given[0]
