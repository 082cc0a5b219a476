"""MQTT connections: each end is an mqtt_client, and both meet at a broker.

The parameters are those of ika-rwth-aachen/mqtt_client v2.5. The client cannot drop a bridge while
it runs, so a change of topics restarts the pod.

The parameters do not contain a broker's user name and password, because the pod reads them from a
Secret (``docs/decisions/0009-credentials-of-brokers.md``).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from demandops import naming
from demandops.config.config import BROKERS_FILE, CLIENTS_FILE, IMAGES_FILE, Config
from demandops.config.config_reader import ConfigReader
from demandops.config.inventory import Broker
from demandops.config.registry import ClientSettings, MqttClientSettings
from demandops.connections.connection import Connection
from demandops.connections.connection_type import (
    UNSUPPORTED,
    ClientKey,
    Connections,
    ConnectionType,
    End,
    make_end,
    message_type,
)
from demandops.connections.route import Route
from demandops.errors import Fault, Refused, fault
from demandops.quoting import quoted

# The path at which the certificate of the CA that signs for the broker is mounted
CA_FILE = "/tls/ca.crt"

_NO_BROKER = "no-broker"


class Mqtt(ConnectionType):
    """The connection type MQTT: both ends are clients of one broker."""

    name = "MQTT"
    number = 1
    image = "mqtt-client"
    options = frozenset({"qos", "retained", "primitive", "reliability", "durability", "queue"})
    renames = True
    takes_broker = True
    speaks_dds = False

    def config_faults(self, config: Config, reader: ConfigReader) -> Iterator[Fault]:
        """Yield a fault if there is a broker, but no image for the clients."""
        if config.brokers and reader.is_missing(IMAGES_FILE, self.image):
            message = f"'{self.image}' is missing; add it, because MQTT connections run it"
            yield fault("images", message).within(IMAGES_FILE)

    def link_faults(self, connection: Connection, config: Config) -> Iterator[Fault]:
        """Yield a fault if :func:`choose_broker` finds no broker for the connection."""
        if not {connection.source, connection.target} <= config.nodes.keys():
            return
        if choose_broker(connection, config) is not None:
            return
        known = ", ".join(sorted(config.brokers))
        remedy = f"name one of: {known}" if known else f"add one to {config.place_of(BROKERS_FILE)}"
        ends = f"'{connection.target}' or '{connection.source}'"
        message = f"no broker is given, and none runs on {ends}"
        if connection.broker:
            message = f"no broker runs on {quoted(connection.broker)}, nor on {ends}"
        yield fault("broker", f"{message}; {remedy}", code=_NO_BROKER)

    def route_faults(
        self, where: str, route: Route, sender: str, config: Config
    ) -> Iterator[Fault]:
        """Yield a fault if ``mqtt.messages`` of the clients does not list the route's package.

        Yield nothing if ``mqtt.messages`` is empty, the message type is unknown, or the message is
        carried as a primitive type.
        """
        package = message_type(route, sender, config).partition("/")[0]
        carried = config.clients.mqtt.messages
        if package and carried and package not in carried and not route.primitive:
            yield fault(
                f"{where}.type",
                f"'{route.source}' carries messages of {package}, and mqtt.messages in "
                f"{config.file_of(CLIENTS_FILE, self.word)} has only {', '.join(carried)}; use an "
                "image that has the package, and add the package to mqtt.messages",
                code=UNSUPPORTED,
            )

    def settled(self, connection: Connection, config: Config) -> tuple[Connection, str]:
        """Return the connection, and a note if it gets another broker than it names.

        A connection that names no broker stays as it is. In a connection that names one, the broker
        that :func:`choose_broker` chooses replaces the named broker.
        """
        broker = choose_broker(connection, config)
        if not connection.broker or broker is None or broker.node == connection.broker:
            return connection, ""
        note = (
            f"uses the broker on '{broker.node}', because {config.place_of(BROKERS_FILE)} has "
            f"none on {quoted(connection.broker)}"
        )
        return replace(connection, broker=broker.node), note

    def access(self, connection: Connection, config: Config) -> list[tuple[str, str]]:
        """Return the broker's node, which ``brokers`` in a policy's rule must allow."""
        broker = choose_broker(connection, config)
        return [("brokers", broker.node)] if broker else []

    def names(self, key: ClientKey) -> Iterator[tuple[str, str]]:
        """Yield the names of :meth:`ConnectionType.names`, and the channel that both ends share."""
        yield from ConnectionType.names(self, key)
        if key.side == "source":
            yield "MQTT channel", naming.object_name(self.word, key.id)

    def client(self, key: ClientKey, connections: Connections, config: Config) -> MqttEnd | None:
        """Return the end that ``key`` identifies; ``None`` if its connection carries no topic."""
        connection = connections.get(key.id)
        if connection is None or not connection.topics:
            return None
        broker = choose_broker(connection, config)
        if broker is None:
            message = (
                f"connection '{key.id}' has no broker; add one on '{connection.target}' or "
                f"'{connection.source}' to {config.place_of(BROKERS_FILE)}"
            )
            raise Refused.at("broker", message, code=_NO_BROKER)
        channel = naming.object_name(self.word, key.id)
        if broker.topic_prefix:
            channel = f"{broker.topic_prefix}/{channel}"
        end = make_end(MqttEnd, key, connection, config, broker=broker, channel=channel)
        own = end.domain.broker_credentials.get(broker.node, broker.credentials)
        return replace(end, broker=broker.model_copy(update={"credentials": own}))


MQTT = Mqtt()


def choose_broker(connection: Connection, config: Config) -> Broker | None:
    """Return the broker of a connection, or ``None`` if no broker fits.

    The choice is that of the reference. If there is only one broker, it is chosen. If there are
    several, the function looks for a broker on the node that the connection names, then on the
    target, then on the source.
    """
    if len(config.brokers) == 1:
        return next(iter(config.brokers.values()))
    for node in map(config.host_of, (connection.broker, connection.target, connection.source)):
        if node in config.brokers:
            return config.brokers[node]
    return None


@dataclass(frozen=True, slots=True)
class MqttEnd(End):
    """One end of an MQTT connection."""

    broker: Broker
    # The prefix of this connection's MQTT topics, the same at both ends
    channel: str

    def facts(self) -> list[str]:
        """Return one line for each topic, and one for the broker."""
        return [*End.facts(self), f"broker {self.broker.node}"]

    def shaping_entries(self, config: Config) -> Iterable[tuple[str, str, str]]:
        """Yield the entries of :meth:`End.shaping_entries`, and the broker's entry."""
        yield from End.shaping_entries(self, config)
        broker = self.broker
        yield (
            config.file_of(BROKERS_FILE, broker.node),
            broker.node,
            f"broker at {broker.host}:{broker.port}",
        )

    def environment(self, settings: ClientSettings) -> dict[str, str]:
        """Return the variables that set the ROS domain and the middleware.

        If the middleware is ``image``, there is no variable for it, so the image chooses one.
        """
        ros = self.node.ros
        rmw = (isinstance(settings, MqttClientSettings) and settings.rmw) or ros.rmw
        chosen = {} if rmw == "image" else {"RMW_IMPLEMENTATION": rmw}
        return {"ROS_DOMAIN_ID": str(ros.domain_id), **chosen}

    def configuration(self) -> dict[str, Any]:
        """Return the content of one end's ROS parameter file.

        Each ROS topic has one MQTT topic. The MQTT topic is named after the connection and the
        source topic, because the name of the ROS topic may differ between the ends.
        """
        bridge: dict[str, Any] = {}
        read = {route.read_topic: route for route in self.topics if self.reads(route)}
        written = [route for route in self.topics if not self.reads(route)]
        if read:
            bridge["ros2mqtt"] = {"ros_topics": sorted(read)}
            for topic, route in sorted(read.items()):
                bridge["ros2mqtt"][topic] = {
                    "mqtt_topic": self.channel + route.source,
                    **_options(route, retained=route.retained),
                }
        if written:
            bridge["mqtt2ros"] = {"mqtt_topics": [self.channel + one.source for one in written]}
            for route in written:
                bridge["mqtt2ros"][self.channel + route.source] = {
                    "ros_topic": route.written_topic,
                    **_options(route),
                }
        parameters = {
            "broker": _broker(self.broker),
            "client": {"id": self.name},
            "bridge": bridge,
        }
        return {"/**/*": {"ros__parameters": parameters}}


def _broker(broker: Broker) -> dict[str, Any]:
    data: dict[str, Any] = {"host": broker.host, "port": broker.port}
    if broker.tls:
        data["tls"] = {"enabled": True}
        if broker.tls.ca_secret:
            data["tls"]["ca_certificate"] = CA_FILE
    return data


def _options(route: Route, *, retained: bool = False) -> dict[str, Any]:
    """Return the parameters that a topic needs besides the client's defaults."""
    options: dict[str, Any] = {}
    if route.primitive:
        options["primitive"] = True
    if route.type:
        options["ros_type"] = route.type
    ros: dict[str, Any] = {"queue_size": route.queue} if route.queue else {}
    qos = {"reliability": route.reliability, "durability": route.durability}
    qos = {name: value for name, value in qos.items() if value}
    ros |= {"qos": qos} if qos else {}
    mqtt: dict[str, Any] = {"qos": route.qos} if route.qos else {}
    mqtt |= {"retained": True} if retained else {}
    advanced = {name: part for name, part in (("ros", ros), ("mqtt", mqtt)) if part}
    return {**options, "advanced": advanced} if advanced else options
