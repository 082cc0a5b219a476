"""The real Zenoh reads the rendered configuration of the bridges, and the nodes connect.

Zenoh's library stands in for the bridges. It reads the same configuration and refuses unknown
fields, except in the part for the bridges' plugin, which the library lacks. Only our schema checks
that part.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest
import yaml
import zenoh

from tests.e2e.rig.net import free_port
from tests.golden.cases import rendered
from tests.kit.rig import wait_until

STEP = "2-station00-joins"
"""A step of the golden case `zenoh` in which the edge and the station have an endpoint."""


@pytest.fixture(scope="module")
def configurations() -> dict[str, str]:
    """Return the rendered configuration of each node's bridge, with addresses of this machine."""
    found = {}
    for path, text in rendered("zenoh")[STEP].items():
        name = path.rsplit("/", 1)[-1].removesuffix(".yaml")
        if path.startswith("clusters/") and name.startswith("zenoh-"):
            config, _ = yaml.safe_load_all(text)
            found[name.removeprefix("zenoh-")] = config["data"]["config.json5"]
    edge, station, router = (f"127.0.0.1:{free_port()}" for _ in range(3))
    here = {
        "edge.example:7448": edge,
        "10.0.0.2:7448": edge,
        "station00.example:7447": station,
        "0.0.0.0:7447": station,
        "router.example:7447": router,
    }
    for written, address in here.items():
        found = {node: text.replace(written, address) for node, text in found.items()}
    return found


@pytest.fixture(scope="module")
def sessions(configurations: dict[str, str]) -> Iterator[dict[str, Any]]:
    """Open a Zenoh session for each node with its configuration, except the plugin's part."""
    opened = {}
    for node, text in configurations.items():
        whole = json.loads(text)
        del whole["plugins"]
        opened[node] = zenoh.open(zenoh.Config.from_json5(json.dumps(whole)))
    yield opened
    for session in opened.values():
        session.close()


def test_zenoh_reads_the_whole_text_and_refuses_a_field_that_it_does_not_know(
    configurations: dict[str, str],
) -> None:
    assert configurations.keys() == {"edge", "station00", "vehicle00"}
    for text in configurations.values():
        assert zenoh.Config.from_json5(text)
        with pytest.raises(zenoh.ZError):
            zenoh.Config.from_json5(json.dumps(json.loads(text) | {"listne": {}}))


def test_each_node_links_with_those_it_has_connections_with_and_data_arrives(
    sessions: dict[str, Any],
) -> None:
    ids = {str(session.info.zid()): node for node, session in sessions.items()}

    def links() -> dict[str, set[str]]:
        return {
            node: {ids[str(peer)] for peer in session.info.routers_zid()}
            for node, session in sessions.items()
        }

    expected = {"edge": {"station00", "vehicle00"}, "station00": {"edge"}, "vehicle00": {"edge"}}
    wait_until(lambda: links() == expected, "they link with no other")
    arrived: list[bytes] = []
    subscriber = sessions["edge"].declare_subscriber(
        "points", lambda sample: arrived.append(bytes(sample.payload))
    )

    def put() -> bool:
        sessions["vehicle00"].put("points", b"here")  # again and again: a subscription needs time
        return bool(arrived)

    wait_until(put, "it arrives")
    subscriber.undeclare()
    assert set(arrived) == {b"here"}
