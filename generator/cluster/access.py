"""How the clusters are reached: a file of the operator's that is not part of the state repo.

Optional. With a kubeconfig a cluster tells what became of a demand, and is woken after a push; a
Flux Receiver's URL, which is a secret, can only wake.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import Field, model_validator

from generator.catalog.model import DnsLabel, FileModel, Frozen, parse_file
from generator.errors import InvalidInput, fault


class Reached(Frozen):
    """How one cluster is reached: through its API, by the webhook of a Flux Receiver, or both.

    ``wake``: whether its source controller is told to fetch after a push.
    """

    kubeconfig: Path | None = Field(default=None, strict=False)
    context: str | None = None
    receiver: str | None = Field(default=None, pattern=r"^https?://\S+$")
    wake: bool = True

    @model_validator(mode="after")
    def _some_way(self) -> Reached:
        if not (self.kubeconfig or self.receiver):
            raise ValueError("needs a kubeconfig or a receiver")
        return self

    def client(self) -> Any:  # noqa: ANN401 - the library has no types
        """Return a client of the cluster's API.

        Raises:
            ConfigException, OSError: of the library, where the kubeconfig cannot be used.
        """
        from kubernetes import config  # noqa: PLC0415 - half a second; only when used

        return config.new_client_from_config(str(self.kubeconfig), self.context)


class AccessFile(FileModel):
    """The operator's file: cluster name → how it is reached."""

    kind: Literal["ClusterAccess"]
    clusters: dict[DnsLabel, Reached]


def read(path: Path) -> AccessFile:
    """Read the operator's file.

    Raises:
        InvalidInput: with every fault.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        reason = error.strerror or str(error)
        raise InvalidInput([fault("", f"cannot be read: {reason}").within(str(path))]) from None
    return parse_file(AccessFile, text, str(path))
