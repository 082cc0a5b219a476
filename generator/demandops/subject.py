"""Subjects of claims: an application or a connection, by its exact id."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import TypeAlias

# The identity of a topic within its subject. In an application, that is role, topic and source; an
# application without inputs has one empty key. In a connection, that is the topic's name on the
# source node.
TopicKey: TypeAlias = "tuple[str, ...]"


class SubjectKind(Enum):
    # the values are the names of folders in ledger/
    APPLICATION = "applications"
    CONNECTION = "connections"


@dataclass(frozen=True, slots=True)
class Subject:
    kind: SubjectKind
    id: str

    def __str__(self) -> str:
        return f"{self.kind.value[:-1]} '{self.id}'"
