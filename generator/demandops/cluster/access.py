"""How the clusters are reached: a file of the operator's that is not part of the state repo.

Optional. With a kubeconfig a cluster tells what became of a demand, and is woken after a push; the
webhook of its Flux or Argo CD can only wake. What signs the calls of a webhook stands in a file of
its own, never in this one.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import Field, model_validator

from demandops.config.base_model import DnsLabel, FileModel, FrozenModel, parse_file
from demandops.errors import Fault, InvalidInput, fault


class NoAccess(ValueError):
    """A cluster cannot be called, for a reason in the operator's files; it names no secret."""


class ClusterAccess(FrozenModel):
    """How one cluster is reached: through its API, by a webhook of its controller, or both.

    ``receiver`` is the URL of a Flux Receiver, ``webhook`` that of an Argo CD; ``secret_file``
    holds what signs calls of them. ``wake``: whether it is told to fetch after a push.
    """

    kubeconfig: Path | None = Field(default=None, strict=False)
    context: str | None = None
    receiver: str | None = Field(default=None, pattern=r"^https?://\S+$")
    webhook: str | None = Field(default=None, pattern=r"^https?://\S+$")
    secret_file: Path | None = Field(default=None, strict=False)
    wake: bool = True

    @model_validator(mode="after")
    def _some_way(self) -> ClusterAccess:
        called = self.receiver or self.webhook
        if not (self.kubeconfig or called):
            raise ValueError("needs a kubeconfig, a receiver or a webhook")
        if self.secret_file and not called:
            raise ValueError("has a secret_file and nothing it signs; add a receiver or a webhook")
        return self

    def secret(self) -> bytes | None:
        """Read what signs calls of the webhook, anew each time, so that it can be replaced.

        A line end at its end is no part of it.

        Raises:
            OSError: where it cannot be read.
            NoWay: where it is empty, or others may read it.
        """
        if self.secret_file is None:
            return None
        if self.secret_file.stat().st_mode & 0o007:
            raise NoAccess("may be read by everybody on this machine; chmod o= it")
        text = self.secret_file.read_bytes().removesuffix(b"\n").removesuffix(b"\r")
        if not text:
            raise NoAccess("is empty")
        return text

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
    clusters: dict[DnsLabel, ClusterAccess]


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
    found = parse_file(AccessFile, text, str(path))
    faults = [told for name, one in found.clusters.items() for told in _of_secret(name, one)]
    if faults:
        raise InvalidInput([told.within(str(path)) for told in faults])
    return found


def _of_secret(cluster: str, reached: ClusterAccess) -> list[Fault]:
    field = f"clusters.{cluster}.secret_file"
    try:
        reached.secret()
    except OSError as error:
        reason = error.strerror or type(error).__name__
        return [fault(field, f"{reached.secret_file} cannot be read: {reason}")]
    except NoAccess as error:
        return [fault(field, f"{reached.secret_file} {error}")]
    return []
