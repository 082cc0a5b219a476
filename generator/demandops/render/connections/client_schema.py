"""The check of a communication client's configuration before it is committed.

The schemas (``templates/connections/<type>/schema.json``) are our own and list the fields that each
client reads. A client ignores an unknown field or crashes on it, which shows only on the node.
"""

from __future__ import annotations

import json
from functools import lru_cache
from typing import Any

import jsonschema_rs

from demandops.config.base_model import field_path
from demandops.errors import InvalidInput, fault
from demandops.settings import data_folder


def check(kind: str, configuration: dict[str, Any], release: str) -> None:
    """Check the configuration of a client (``mqtt``, ``zenoh``, ``ros``) against its schema.

    Raises:
        InvalidInput: naming each field that does not match. It is a fault of the program, not of a
            demand.
    """
    faults = [
        fault(field_path(tuple(error.instance_path)), error.message).within(f"{kind} of {release}")
        for error in _validator(kind).iter_errors(configuration)
    ]
    if faults:
        raise InvalidInput(faults)


@lru_cache(maxsize=8)
def _validator(kind: str) -> Any:  # noqa: ANN401
    file = data_folder("templates") / "connections" / kind / "schema.json"
    return jsonschema_rs.Draft7Validator(json.loads(file.read_text()))
