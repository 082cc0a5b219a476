"""Reads a recorded bag, MCAP or sqlite3, without ROS. Only this module imports rosbags."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from demandops.detection.events.detection_state import Observation
from demandops.detection.message_reader import MessageReader, Unreadable
from demandops.detection.rules.rule_file import RuleFile
from demandops.detection.rules.topic_pattern import entity_in
from demandops.errors import InvalidInput
from demandops.quoting import one_line
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

# Stands in `left_out` for the damaged end of a bag, whose topics are unknown. Its count is 1, as
# the lost messages cannot be counted.
REST_OF_BAG = "the rest of the bag"


class RecordedBag:
    def __init__(self, path: Path, file: RuleFile) -> None:
        """Open a bag, which must have a topic that the rules read: its folder or an MCAP file."""
        try:
            self._reader = AnyReader([path], default_typestore=get_typestore(Stores.LATEST))
            self._reader.open()
        except Exception as error:  # a damaged bag makes the library raise errors of any kind
            message = f"is not a bag that can be read: {one_line(str(error))}"
            raise InvalidInput.at("", message, file=str(path)) from None
        self._readers = {name: MessageReader(file, name) for name in file.sources}
        self._sources: dict[int, list[tuple[str, str]]] = {}
        self.topics: set[str] = set()
        # Topics that match a source by name, but not by their message type.
        self.unread: dict[str, str] = {}
        # The number of unreadable messages by topic and reason, each once for a source.
        self.left_out: dict[tuple[str, str], int] = {}
        for connection in self._reader.connections:
            for name, source in file.sources.items():
                entity = entity_in(source.topic, connection.topic)
                if entity is None:
                    continue
                if connection.msgtype == source.type:
                    self._sources.setdefault(connection.id, []).append((name, entity))
                    self.topics.add(connection.topic)
                else:
                    self.unread[connection.topic] = connection.msgtype
        if not self.topics:
            wanted = ", ".join(f"{each.topic} ({each.type})" for each in file.sources.values())
            topics = sorted({f"{each.topic} ({each.msgtype})" for each in self._reader.connections})
            recorded = ", ".join(topics) or "no topic"
            self.close()
            message = f"has no topic that the rules read: {wanted}; it has {recorded}"
            raise InvalidInput.at("", message, file=str(path))

    def close(self) -> None:
        self._reader.close()

    @property
    def span(self) -> tuple[float, float]:
        """The times of the first and the last message of all topics, in seconds since 1970."""
        return self._reader.start_time / 1e9, (self._reader.end_time - 1) / 1e9

    def observations(self) -> Iterator[Observation]:
        connections = [each for each in self._reader.connections if each.id in self._sources]
        messages = self._reader.messages(connections=connections)
        while True:
            try:
                connection, nanoseconds, data = next(messages)
            except StopIteration:
                return
            except Exception as error:  # the rest of a damaged bag
                self._leave_out(REST_OF_BAG, f"cannot be read: {error!r}")
                return
            for source, entity in self._sources[connection.id]:
                try:
                    message = self._reader.deserialize(data, connection.msgtype)
                except Exception as error:  # rosbags raises errors of many kinds
                    self._leave_out(connection.topic, f"cannot be decoded: {error!r}")
                    continue
                try:
                    yield self._readers[source].observation(message, entity, nanoseconds / 1e9)
                except Unreadable as error:
                    self._leave_out(connection.topic, str(error))

    def _leave_out(self, topic: str, why: str) -> None:
        key = topic, one_line(why)
        self.left_out[key] = self.left_out.get(key, 0) + 1
