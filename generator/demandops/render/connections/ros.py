"""ROS connections: each end is an eProsima DDS-Router that links the node to the other end.

Configuration as DDS-Router v3.5 reads it (version v5.0). A running router accepts a new allowlist
from the mounted file, which it reads again at an interval. Any other change restarts the pod.
"""

from __future__ import annotations

import ipaddress
from typing import Any

from demandops import strict_yaml
from demandops.config.config import DDS_ROUTER_IMAGE, Config
from demandops.connections.route import Route
from demandops.plan.release import Address, RosEnd
from demandops.render.connections import client_pod, client_schema
from demandops.render.engine import Engine

RELOAD_SECONDS = 10
"""How often a router reads its file again: its file watcher misses ConfigMap changes."""

_LOCAL, _WAN = "local", "wan"


def dds_type(ros_type: str) -> str:
    """Return the DDS name of a message type: ``std_msgs::msg::dds_::String_``."""
    package, kind, name = ros_type.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def configuration(end: RosEnd) -> dict[str, Any]:
    """Return the configuration of one end's router.

    A topic passes only from the end that reads it to the end that writes it. Most topics come from
    the source. The general routes cover them, so that a new one needs no restart.
    """
    inward, outward = _routes(_LOCAL, _WAN), _routes(_WAN, _LOCAL)
    topics = [
        {"name": f"rt{route.read_topic}", "type": dds_type(route.type)} for route in _all(end)
    ]
    tuned = [
        {**topic, "qos": qos}
        for topic, route in zip(topics, _all(end), strict=True)
        if (qos := _qos(route, reads=end.reads(route)))
    ]
    reverse = [
        {**topic, "routes": inward if end.reads(route) else outward}
        for topic, route in zip(topics, _all(end), strict=True)
        if route.reverse
    ]
    return {
        "version": "v5.0",
        "allowlist": topics,
        **({"topics": tuned} if tuned else {}),
        "routes": inward if end.side == "source" else outward,
        **({"topic-routes": reverse} if reverse else {}),
        "participants": [
            {"name": _LOCAL, "kind": "local", "domain": end.node.ros.domain_id},
            {
                "name": _WAN,
                "kind": "wan",
                "listening-addresses" if end.listens else "connection-addresses": [
                    _address(end.address)
                ],
            },
        ],
    }


def _all(end: RosEnd) -> list[Route]:
    return list(end.topics.values())


def _routes(sender: str, receiver: str) -> list[dict[str, Any]]:
    """Return the routes that let only one participant send to the other."""
    return [{"src": sender, "dst": [receiver]}, {"src": receiver}]


def _qos(route: Route, *, reads: bool) -> dict[str, Any]:
    """Return a topic's settings; the end that reads the topic limits its rate, before the link."""
    qos: dict[str, Any] = {}
    if route.reliability:
        qos["reliability"] = route.reliability == "reliable"
    if route.durability:
        qos["durability"] = route.durability == "transient_local"
    if route.queue:
        qos["history-depth"] = route.queue
    if route.rate and reads:
        qos["max-tx-rate"] = route.rate
    return qos


def _address(address: Address) -> dict[str, Any]:
    return {
        "ip" if _is_ip(address.host) else "domain": address.host,
        "port": address.port,
        "transport": address.transport,
    }


def _is_ip(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def render(end: RosEnd, config: Config, engine: Engine) -> str:
    """Return the manifests of one end as one YAML text."""
    data = configuration(end)
    client_schema.check("ros", data, end.name)
    needs_restart = {name: value for name, value in data.items() if name != "allowlist"}
    return engine.text(
        "connections/ros/end.yaml.j2",
        end=end,
        configuration=strict_yaml.dump(data),
        checksum=client_pod.checksum(strict_yaml.dump(needs_restart)),
        reload_seconds=RELOAD_SECONDS,
        **client_pod.context(end, DDS_ROUTER_IMAGE, config),
    )
