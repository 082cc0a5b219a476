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

from demandops.base.errors import InvalidInput, Unsound
from demandops.base.quoting import quoted
from demandops.base.runtime import REAL, Runtime, log
from demandops.cluster.clusters_file import own_cluster_api, reason_of

_LEASE_S = 15  # how long a Lease is valid if nobody renews it
_RENEW_WITHIN_S = 10  # a leader that has not renewed its Lease for so long ends its process
# How long a call of the API may take. A renewal has two calls, and must end before the Lease does:
# _RENEW_WITHIN_S + 2 * _CALL_S < _LEASE_S.
_CALL_S = 2
# The API server takes no Lease with a duration of 0, so a released one is valid for a second.
_RELEASED_S = 1
_NAME = re.compile(r"([a-z0-9]([-a-z0-9]*[a-z0-9])?)/([a-z0-9]([-.a-z0-9]*[a-z0-9])?)")


class Leadership:
    def __init__(
        self,
        lease: str,
        may_lead: Callable[[], bool],
        on_leader: Callable[[], object],
        api: Any = None,  # noqa: ANN401 - the library has no types
        runtime: Runtime = REAL,
    ) -> None:
        # It competes for the Lease ``NAMESPACE/NAME``, which must exist. A leader that cannot renew
        # it, or has lost it, raises Unsound in its thread. Without ``api``, this must be a pod.
        if (name := _NAME.fullmatch(lease)) is None:
            message = f"{quoted(lease)} names no Lease; write NAMESPACE/NAME"
            raise InvalidInput.at("--leader-lease", message)
        self._request = {
            "group": "coordination.k8s.io",
            "version": "v1",
            "plural": "leases",
            "namespace": name[1],
            "name": name[3],
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
                log.warning("the Lease %s could not be released: %s", self._lease, reason_of(error))

    def _run(self) -> None:
        while not self._closed.is_set():
            try:
                self._compete()
            except Unsound:
                raise
            except Exception as error:  # the library raises errors of many kinds
                problem = f"cannot be read or written: {reason_of(error)}"
                self._tell(logging.WARNING, f"the Lease {self._lease} {problem}")
            self._require_renewed()
            self._closed.wait(2.0)
            self._require_renewed()  # a renewal that begins now could end too late

    def _compete(self) -> None:
        lease = self._read()
        spec = lease.get("spec") or {}
        holder = spec.get("holderIdentity") or ""
        if self.is_leader and holder != self._identity:
            self._end(f"is held by {quoted(holder)}")
        if not self.is_leader:
            # Time counts from when this process saw the Lease change: the clock of the leader, of
            # which the Lease has a time, may be wrong.
            if spec != self._seen:
                self._seen, self._seen_at = spec, self._runtime.monotonic()
            ends = self._seen_at + (spec.get("leaseDurationSeconds") or _LEASE_S)
            is_free = holder in ("", self._identity) or self._runtime.monotonic() >= ends
            if not self._may_lead():
                return
            if not is_free:
                self._tell(logging.INFO, f"standing by: the leader is {quoted(holder)}")
                return
        # the time before the call, because others count from when the call takes effect
        began = self._runtime.monotonic()
        self._write(lease, self._identity)
        self._renewed, self._told = began, ""
        if not self.is_leader:
            self.is_leader = True
            log.info("this process is the leader: it holds the Lease %s", self._lease)
            self._on_leader()

    def _require_renewed(self) -> None:
        # a process that was suspended, or whose calls hang, must not go on serving beside another
        if self.is_leader and self._runtime.monotonic() - self._renewed >= _RENEW_WITHIN_S:
            why = f" ({self._told})" if self._told else ""  # empty if this process was suspended
            self._end(f"was not renewed for {_RENEW_WITHIN_S} s{why}")

    def _read(self) -> dict[str, Any]:
        lease: dict[str, Any] = self._api.get_namespaced_custom_object(
            **self._request, _request_timeout=_CALL_S
        )
        return lease

    def _write(self, lease: dict[str, Any], holder: str) -> None:
        """Write a holder into the Lease that was read; an empty ``holder`` releases the Lease."""
        old, now = lease.get("spec") or {}, f"{self._runtime.now():%Y-%m-%dT%H:%M:%S.%fZ}"
        spec = old | {
            "holderIdentity": holder,
            "leaseDurationSeconds": _LEASE_S if holder else _RELEASED_S,
            "renewTime": now,
        }
        if holder and not self.is_leader:
            spec["acquireTime"] = now
            spec["leaseTransitions"] = (old.get("leaseTransitions") or 0) + 1
        # The body has the resourceVersion that was read. So the server refuses it if another
        # process has changed the Lease since.
        self._api.replace_namespaced_custom_object(
            **self._request, body=lease | {"spec": spec}, _request_timeout=_CALL_S
        )

    def _tell(self, level: int, text: str) -> None:
        if text != self._told:  # each pause ends with the same text, as long as nothing changes
            log.log(level, "%s", text)
        self._told = text

    def _end(self, why: str) -> None:
        self.is_leader = False
        raise Unsound(
            f"the Lease {self._lease} {why}; another process may be the leader now, so this one "
            "must start again"
        )
