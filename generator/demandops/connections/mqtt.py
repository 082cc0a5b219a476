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

from demandops.base import naming
from demandops.base.addresses import in_url
from demandops.base.errors import Fault, Refused, fault
from demandops.base.quoting import quoted
from demandops.connections import connection as routes
from demandops.connections.connection import ClientKey, Connection, ConnectionType, End, Route
from demandops.model.config import config as configs
from demandops.model.config.config import Config, ConfigReader
from demandops.model.config.inventory import Broker
from demandops.model.config.registry import ClientSettings, MqttClientSettings

# The path at which the certificate of the CA that signs for the broker is mounted
CA_FILE = "/tls/ca.crt"

_NO_BROKER = "no-broker"


class Mqtt(ConnectionType):
    name, word = "MQTT", "mqtt"
    number = 1
    image = "mqtt-client"
    options = frozenset({"qos", "retained", "primitive", "reliability", "durability", "queue"})
    renames = True
    takes_broker = True
    speaks_dds = False
    one_derived_route = True
    channel = "MQTT channel"

    def config_faults(self, config: Config, reader: ConfigReader) -> Iterator[Fault]:
        if reader.places[configs.BROKERS_FILE] and reader.is_missing(
            configs.IMAGES_FILE, self.image
        ):
            message = f"'{self.image}' is missing; add it, because MQTT connections run it"
            yield fault("images", message).within(configs.IMAGES_FILE)

    def link_faults(self, connection: Connection, config: Config) -> Iterator[Fault]:
        if choose_broker(connection, config) is not None:
            return
        for node in _asked(connection, config):
            if problem := config.broker_patterns.find(node)[1]:
                place = config.place_of(configs.BROKERS_FILE)
                yield fault("broker", f"{quoted(node)} {problem} ({place})", code=_NO_BROKER)
                return
        remedy = f"name one of: {', '.join(sorted(config.brokers))}"
        place = config.place_of(configs.DOMAINS_FILE)
        remedy += f", or ask for a 'broker' of the access domain in {place}"
        if not (config.brokers or config.broker_patterns):
            remedy = f"add one to {config.place_of(configs.BROKERS_FILE)}"
        ends = f"'{connection.target}' or '{connection.source}'"
        message = f"no broker is given, and none runs on {ends}"
        if connection.broker:
            message = f"no broker runs on {quoted(connection.broker)}, nor on {ends}"
        yield fault("broker", f"{message}; {remedy}", code=_NO_BROKER)

    def route_faults(
        self, where: str, route: Route, sender: str, config: Config
    ) -> Iterator[Fault]:
        # the image of a client has the code of some packages' messages only
        package = routes.message_type(route, sender, config).partition("/")[0]
        carried = config.clients.mqtt.messages
        if package and carried and package not in carried and not route.primitive:
            message = (
                f"'{route.source}' carries messages of {package}, and mqtt.messages in "
                f"{config.file_of(configs.CLIENTS_FILE, self.word)} has only {', '.join(carried)}; "
                "use an image that has the package, and add the package to mqtt.messages"
            )
            yield fault(f"{where}.type", message, code=routes.UNSUPPORTED)

    def broker_node(self, connection: Connection, config: Config) -> str:
        broker = choose_broker(connection, config)
        return broker.node if broker else ""

    def client(
        self, key: ClientKey, connections: routes.Connections, config: Config
    ) -> MqttEnd | None:
        connection = connections.get(key.id)
        if connection is None or not connection.topics:
            return None
        broker = choose_broker(connection, config)
        if broker is None:
            message = (
                f"connection '{key.id}' has no broker; add one on '{connection.target}' or "
                f"'{connection.source}' to {config.place_of(configs.BROKERS_FILE)}"
            )
            raise Refused.at("broker", message, code=_NO_BROKER)
        channel = naming.object_name(self.word, key.id)
        if broker.topic_prefix:
            channel = f"{broker.topic_prefix}/{channel}"
        end = routes.make_end(MqttEnd, key, connection, config, broker=broker, channel=channel)
        credentials = end.domain.broker_credentials.get(broker.node, broker.credentials)
        return replace(end, broker=broker.model_copy(update={"credentials": credentials}))


MQTT = Mqtt()


def choose_broker(connection: Connection, config: Config) -> Broker | None:
    # as the reference chooses: the only broker, or else the named one, then that of an end
    if len(config.brokers) == 1 and not config.broker_patterns:
        return next(iter(config.brokers.values()))
    for node in _asked(connection, config):
        if node in config.brokers:
            return config.brokers[node]
        if config.broker_patterns.find(node)[1]:
            return None  # what the patterns do not say clearly is refused, not passed over
    return None


def _asked(connection: Connection, config: Config) -> Iterator[str]:
    ends = (connection.target, connection.source)
    domains = (domain for end in ends if (domain := config.domain_of.get(end)))
    defaults = (domain.broker or "" for domain in domains)
    return map(config.host_of, (connection.broker, *ends, *defaults))


@dataclass(frozen=True, slots=True)
class MqttEnd(End):
    broker: Broker
    # The prefix of this connection's MQTT topics, the same at both ends
    channel: str

    def facts(self) -> list[str]:
        return [*End.facts(self), f"broker {self.broker.node}"]

    def shaping_entries(self, config: Config) -> Iterable[tuple[str, str, str]]:
        yield from End.shaping_entries(self, config)
        broker = self.broker
        yield (
            config.file_of(configs.BROKERS_FILE, broker.node),
            broker.node,
            f"broker at {in_url(broker.host)}:{broker.port}",
        )

    def environment(self, settings: ClientSettings) -> dict[str, str]:
        variables = {"ROS_DOMAIN_ID": str(self.node.ros.domain_id)}
        rmw = (isinstance(settings, MqttClientSettings) and settings.rmw) or self.node.ros.rmw
        if rmw != "image":  # else the image chooses
            variables["RMW_IMPLEMENTATION"] = rmw
        return variables

    def configuration(self) -> dict[str, Any]:
        # An MQTT topic is named after the connection and the source topic, because the name of the
        # ROS topic may differ between the ends.
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
            mqtt_topics = [self.channel + route.source for route in written]
            bridge["mqtt2ros"] = {"mqtt_topics": mqtt_topics}
            for route in written:
                bridge["mqtt2ros"][self.channel + route.source] = {
                    "ros_topic": route.written_topic,
                    **_options(route),
                }
        # the client puts both into a URL as they are
        broker: dict[str, Any] = {"host": in_url(self.broker.host), "port": self.broker.port}
        if self.broker.tls:
            broker["tls"] = {"enabled": True}
            if self.broker.tls.ca_secret:
                broker["tls"]["ca_certificate"] = CA_FILE
        parameters = {"broker": broker, "client": {"id": self.name}, "bridge": bridge}
        # ROS merges the entries of all wildcards: the init container adds user name and password
        # under /**
        return {"/**/*": {"ros__parameters": parameters}}


def _options(route: Route, *, retained: bool = False) -> dict[str, Any]:
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
