"""Reads the operator's file with the access to each cluster (``serve --clusters``).

The file is optional, and not in the state repo. With a kubeconfig, the generator reads a cluster's
objects and wakes its controller after a push. With a webhook of Flux or Argo CD, the generator can
only wake the controller. The secret that signs webhook calls is in a separate file.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from demandops.base import addresses
from demandops.base.errors import InvalidInput, fault
from demandops.base.strict_yaml import located_in, read_input, read_secret, with_lines
from demandops.model.config.base_model import (
    DnsLabel,
    FileModel,
    FrozenModel,
    parse_file,
    readable_by,
)

_Url = Annotated[str, readable_by(lambda text: addresses.url(text, "https", "http"))]


class ClusterAccess(FrozenModel):
    """The access to a cluster: its API, a webhook of its controller, or both."""

    kubeconfig: Path | None = Field(default=None, strict=False)
    context: str | None = None
    receiver: _Url | None = None
    webhook: _Url | None = None
    secret_file: Path | None = Field(default=None, strict=False)
    wake: bool = True

    @model_validator(mode="after")
    def _check_complete(self) -> ClusterAccess:
        url = self.receiver or self.webhook
        if not (self.kubeconfig or url):
            raise ValueError("needs a kubeconfig, a receiver or a webhook")
        if self.secret_file and not url:
            raise ValueError("has a secret_file but no URL; add a receiver or a webhook")
        return self

    def secret(self) -> bytes | None:
        """Return the secret that signs webhook calls; a file that others may read is a fault."""
        # read in each call, so that a secret can be replaced while this process runs
        return read_secret(self.secret_file, private=True) if self.secret_file else None

    def api(self) -> Any:  # noqa: ANN401 - the library has no types
        """Return the cluster's API for objects of any kind. The access must have a kubeconfig."""
        from kubernetes import config  # noqa: PLC0415 - slow (half a second), so only on use

        file, context = str(self.kubeconfig), self.context
        return _api_by(lambda settings: config.load_kube_config(file, context, settings))


def own_cluster_api(wanted_by: str) -> Any:  # noqa: ANN401 - the library has no types
    # Of the cluster in which this process runs as a pod, whose service account has the rights.
    # ``wanted_by`` is the option or command that needs it: InvalidInput names it if this is no pod.
    from kubernetes import config  # noqa: PLC0415 - slow (half a second), so only on use

    try:
        return _api_by(config.load_incluster_config)
    except config.ConfigException as error:
        message = f"needs a pod with a service account's token: {error}"
        raise InvalidInput.at(wanted_by, message) from None


def _api_by(load: Callable[[Any], object]) -> Any:  # noqa: ANN401 - the library has no types
    from kubernetes import client  # noqa: PLC0415 - slow (half a second), so only on use

    settings = client.Configuration()
    # the library would warn of each, and the callers try again; for a Lease there is no time
    settings.retries = False
    load(settings)
    return client.CustomObjectsApi(client.ApiClient(settings))


def reason_of(error: Exception) -> str:
    # of an error of the library, which wraps those of the network several times
    while isinstance(inner := getattr(error, "reason", None) or error.__cause__, Exception):
        error = inner
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    reason = f"{type(error).__name__}: {getattr(error, 'reason', None) or error}"
    return reason.splitlines()[0][:300]


class AccessFile(FileModel):
    """The operator's file: the access to each cluster, by the cluster's name."""

    kind: Literal["ClusterAccess"]
    clusters: dict[DnsLabel, ClusterAccess]


def read(path: Path) -> AccessFile:
    """Return the content of the operator's file, if also the secrets that it names can be read."""
    name, text = read_input(path)
    with located_in(text):
        content = parse_file(AccessFile, text, name)
    faults = []
    for cluster, access in content.clusters.items():
        try:
            access.secret()
        except InvalidInput as error:
            (problem,) = error.faults
            field = f"clusters.{cluster}.secret_file"
            faults.append(fault(field, f"{problem.file} {problem.message}").within(name))
    if faults:
        raise InvalidInput(with_lines(faults, lambda _: text))
    return content
