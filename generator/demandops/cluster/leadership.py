"""Leadership: one of the generators of a state repo, the leader, serves the ROS actions.

Any number of generators may write to a state repo, but only one node may serve an action's name. So
the processes compete for a Kubernetes Lease. The holder of the Lease is the leader, and renews it.
The others stand by. Nothing depends on the clocks of other machines, because each process measures
the time since it saw the Lease change.
"""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Callable
from typing import Any

from demandops.cluster.clusters_file import own_cluster_api
from demandops.errors import InvalidInput, Unsound
from demandops.quoting import quoted
from demandops.runtime import REAL, Runtime

log = logging.getLogger("demandops")

_LEASE_S = 15
"""How many seconds a Lease is valid if nobody renews it."""
_RENEW_WITHIN_S = 10
"""A leader that has not renewed its Lease for this many seconds ends its process."""
_CALL_S = 2
"""How many seconds a call of the API may take. A renewal has two calls, and must end before the
Lease does: ``_RENEW_WITHIN_S + 2 * _CALL_S < _LEASE_S``."""
_PAUSE_S = 2.0
_RELEASED_S = 1
_NAME = re.compile(r"([a-z0-9]([-a-z0-9]*[a-z0-9])?)/([a-z0-9]([-.a-z0-9]*[a-z0-9])?)")


class Leadership:
    """Makes this process compete for the Lease and, as the leader, renew it."""

    def __init__(
        self,
        lease: str,
        may_lead: Callable[[], bool],
        on_leader: Callable[[], object],
        api: Any = None,  # noqa: ANN401 - the library has no types
        runtime: Runtime = REAL,
    ) -> None:
        """Start to compete for the Lease.

        A leader that cannot renew the Lease, or has lost it, raises :class:`Unsound` in its thread,
        because another process is the leader soon or already.

        Args:
            lease: the Lease's namespace and name, with a slash between. The Lease must exist.
            may_lead: returns whether this process may become the leader now.
            on_leader: called when this process becomes the leader.
            api: the cluster's API; by default that of the cluster in which this process is a pod.
            runtime: provides the time and the threads.

        Raises:
            InvalidInput: if the name is not valid, or this process is not a pod.
        """
        found = _NAME.fullmatch(lease)
        if found is None:
            raise InvalidInput.at(
                "--leader-lease", f"{quoted(lease)} names no Lease; write NAMESPACE/NAME"
            )
        self._request = {
            "group": "coordination.k8s.io",
            "version": "v1",
            "plural": "leases",
            "namespace": found[1],
            "name": found[3],
        }
        self._lease, self._may_lead, self._on_leader = lease, may_lead, on_leader
        self._api = own_cluster_api("--leader-lease") if api is None else api
        self._runtime = runtime
        self._identity = f"{os.uname().nodename}_{runtime.fresh_id()}"
        self.is_leader = False
        self._renewed = self._seen_at = runtime.monotonic()
        self._seen: dict[str, Any] | None = None
        self._told = ""
        self._closed = runtime.event()
        self._thread = runtime.keep_running("leader-lease", self._run)

    def close(self) -> None:
        """Stop competing. A leader releases the Lease, so that another process can lead at once."""
        self._closed.set()
        self._thread.join(2 * _CALL_S)
        if self.is_leader:
            self.is_leader = False
            try:
                self._write(self._read(), "")
            except Exception as error:  # the Lease expires on its own
                log.warning("the Lease %s could not be released: %s", self._lease, _reason(error))

    def _run(self) -> None:
        while not self._closed.is_set():
            try:
                self._compete()
            except Unsound:
                raise
            except Exception as error:  # the library raises errors of many kinds
                problem = f"cannot be read or written: {_reason(error)}"
                self._tell(logging.WARNING, f"the Lease {self._lease} {problem}")
            self._require_renewed()
            self._closed.wait(_PAUSE_S)
            self._require_renewed()  # a renewal that begins now could end too late

    def _compete(self) -> None:
        """Renew the Lease as the leader, or become the leader if that is possible now.

        This process becomes the leader if the Lease is free and the process may lead.
        """
        lease = self._read()
        spec = lease.get("spec") or {}
        holder = spec.get("holderIdentity") or ""
        if self.is_leader and holder != self._identity:
            self._end(f"is held by {quoted(holder)}")
        if not self.is_leader:
            if spec != self._seen:
                self._seen, self._seen_at = spec, self._runtime.monotonic()
            ends = self._seen_at + (spec.get("leaseDurationSeconds") or _LEASE_S)
            is_free = holder in ("", self._identity) or self._runtime.monotonic() >= ends
            if not self._may_lead():
                return
            if not is_free:
                self._tell(logging.INFO, f"standing by: the leader is {quoted(holder)}")
                return
        began = self._runtime.monotonic()
        self._write(lease, self._identity)
        self._renewed, self._told = began, ""
        if not self.is_leader:
            self.is_leader = True
            log.info("this process is the leader: it holds the Lease %s", self._lease)
            self._on_leader()

    def _require_renewed(self) -> None:
        if self.is_leader and self._runtime.monotonic() - self._renewed >= _RENEW_WITHIN_S:
            why = f" ({self._told})" if self._told else ""  # empty if this process was suspended
            self._end(f"was not renewed for {_RENEW_WITHIN_S} s{why}")

    def _read(self) -> dict[str, Any]:
        lease: dict[str, Any] = self._api.get_namespaced_custom_object(
            **self._request, _request_timeout=_CALL_S
        )
        return lease

    def _write(self, lease: dict[str, Any], holder: str) -> None:
        """Write a holder into the Lease that was read; an empty ``holder`` releases the Lease.

        The server refuses the call if the Lease has changed since it was read.
        """
        old, now = lease.get("spec") or {}, f"{self._runtime.now():%Y-%m-%dT%H:%M:%S.%fZ}"
        spec = old | {
            "holderIdentity": holder,
            "leaseDurationSeconds": _LEASE_S if holder else _RELEASED_S,
            "renewTime": now,
        }
        if holder and not self.is_leader:
            spec["acquireTime"] = now
            spec["leaseTransitions"] = (old.get("leaseTransitions") or 0) + 1
        self._api.replace_namespaced_custom_object(
            **self._request, body=lease | {"spec": spec}, _request_timeout=_CALL_S
        )

    def _tell(self, level: int, text: str) -> None:
        """Log a text, unless the last logged text was the same."""
        if text != self._told:
            log.log(level, "%s", text)
        self._told = text

    def _end(self, why: str) -> None:
        self.is_leader = False
        raise Unsound(
            f"the Lease {self._lease} {why}; another process may be the leader now, so this one "
            "must start again"
        )


def _reason(error: Exception) -> str:
    reason = f"{type(error).__name__}: {getattr(error, 'reason', None) or error}"
    return reason.splitlines()[0][:300]
