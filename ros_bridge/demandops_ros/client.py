"""The client for programs: puts a demand, keeps it renewed and releases it.

    with DemandClient("vehicle01") as client:
        with client.demand("v1-recording", applications=[{
            "id": "edge/recorder", "type": "recorder", "node": "edge",
            "inputs": {"points": [{"topic": "/points", "source": "vehicle01"}]},
        }]) as demand:
            print(demand.commit)     # published; released at the end of the block

Applications and connections have the fields of a YAML document of the kind ``Demand``
(docs/demand.md). The client has its own ROS context and thread, separate from the caller's own use
of rclpy.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from demandops.base.runtime import REAL, Thread
from demandops.base.settings import DEFAULT_DEMAND_ACTION_NAME
from demandops_interfaces.action import Demand

from demandops_ros.actions import DemandError, GoalSender
from demandops_ros.messages import demand_goal_from_data

__all__ = ["Answer", "DemandClient", "DemandError", "HeldDemand", "StageListener"]

log = logging.getLogger("demandops.client")

StageListener = Callable[[str, str], None]
"""Called with each stage and its text, in the client's thread."""

# The fraction of a lease after which to renew it; a renewal that fails can be repeated in time.
_RENEW_AFTER = 1 / 3
# After so long, a failed renewal is tried again, or sooner if the lease is short.
_RETRY_S = 5.0
_PROBABLY_RELEASED = (
    "the demand holds nothing; an earlier attempt to release it got no response, and has probably "
    "released it"
)


@dataclass(frozen=True, slots=True)
class Answer:
    """The result of a goal.

    ``outcome`` is booked, waiting, released or unchanged. ``commit`` is empty if the demand was
    probably released by an earlier attempt that got no response. ``lease_s`` is 0 without a lease.
    ``reached`` is pushed, reconciled or healthy.
    """

    outcome: str
    commit: str
    lease_s: float
    warnings: tuple[str, ...]
    reached: str


class DemandClient:
    """Sends demands of ``requesters`` to one node."""

    def __init__(
        self,
        *requesters: str,
        action_name: str = DEFAULT_DEMAND_ACTION_NAME,
        node_name: str = "demandops_client",
        timeout_s: float = 60.0,
        domain_id: int | None = None,
    ) -> None:
        """Start the client.

        Args:
            requesters: the requesters of every demand.
            action_name: the name under which the node serves the action ``Demand``.
            node_name: the name of the client's own ROS node.
            timeout_s: how many seconds one call, such as :meth:`put`, may take.
            domain_id: the ROS domain; by default that of the environment.
        """
        self.requesters = requesters
        self.timeout_s = timeout_s
        self._sender = GoalSender(Demand, action_name, node_name, timeout_s, domain_id)

    def __enter__(self) -> DemandClient:
        """Return the client itself."""
        return self

    def __exit__(self, *reason: object) -> None:
        """Close the client; this releases no demand."""
        self.close()

    def close(self) -> None:
        """Stop the client's thread and destroy its node."""
        self._sender.close()

    def put(
        self,
        demand: str,
        applications: Iterable[Mapping[str, Any]] = (),
        connections: Iterable[Mapping[str, Any]] = (),
        *,
        lease: float | str | None = None,
        answer: str = "pushed",
        request: str = "",
        on_stage: StageListener = lambda stage, text: None,
    ) -> Answer:
        """Replace the content of a demand, and return the answer.

        By default, the call returns when the change is published.

        Args:
            demand: the demand's id.
            applications, connections: as in a YAML document of the kind ``Demand``.
            lease: seconds, which the node rounds up to whole ones, or a duration like ``10m``. With
                None or 0, the access domain's lease, if it has one.
            answer: the call returns once the change is ``pushed``, ``reconciled`` or ``healthy``. A
                node without access to the clusters answers at ``pushed``, with a warning.
            request: free text for the commit.
            on_stage: called with each stage and its text.

        Raises:
            DemandError: if the demand fails or no answer arrives in time. After the code
                ``timeout``, nobody knows whether the demand is booked. After ``not-reconciled``
                and ``not-healthy``, it is booked.
            ValueError, TypeError, AssertionError, AttributeError, OverflowError: for a field or a
                value that the message cannot carry.
        """
        data = {
            "demand": demand,
            "request": request,
            "answer": answer,
            "applications": list(applications),
            "connections": list(connections),
            "lease": lease,
        }
        return self.send(data, on_stage)

    def renew(self, demand: str) -> Answer:
        """Renew a demand's leases, and return the answer.

        Raises:
            DemandError: as in :meth:`put`; with the code ``not-held`` if the demand has ended.
        """
        return self.send({"operation": "renew", "demand": demand})

    def release(self, demand: str) -> Answer:
        """Release all that a demand holds, and return the answer.

        Raises:
            DemandError: as in :meth:`put`; with the code ``not-held`` if the demand holds nothing.
                But if an earlier attempt to send the release got no response, the call returns an
                answer with a warning.
        """
        return self.send({"operation": "release", "demand": demand})

    def demand(self, demand: str, *args: Any, **options: Any) -> HeldDemand:  # noqa: ANN401
        """Return a demand that is held during a ``with`` block.

        The arguments are those of :meth:`put`.
        """
        return HeldDemand(self, demand, lambda: self.put(demand, *args, **options))

    def send(
        self, data: Mapping[str, Any], on_stage: StageListener = lambda stage, text: None
    ) -> Answer:
        """Send a document of the kind ``Demand`` and return the answer; see :meth:`put`.

        If the document has no ``requesters``, those of the client are added.
        """
        goal = demand_goal_from_data({"requesters": list(self.requesters), **data})
        succeeded, result, lost = self._sender.send(
            goal, lambda feedback: on_stage(feedback.stage, feedback.message)
        )
        # an attempt that got no response may have released the demand all the same
        if lost and result.code == "not-held" and goal.operation == Demand.Goal.OPERATION_RELEASE:
            return Answer("released", "", 0.0, (_PROBABLY_RELEASED,), "pushed")
        if not succeeded:
            raise DemandError(result.code or "aborted", result.message)
        lease_s = result.lease.sec + result.lease.nanosec / 1e9
        warnings = tuple(result.warnings)
        return Answer(result.outcome, result.commit, lease_s, warnings, result.reached)


class HeldDemand:
    """A demand that is put at the start of a block, renewed during it and released at its end.

    Only a demand with a lease is renewed. If it has ended all the same, it is put again.
    ``answer`` and ``commit`` are those of the last put; before it, None and empty.
    """

    def __init__(self, client: DemandClient, demand: str, put: Callable[[], Answer]) -> None:
        self.id = demand
        self.commit = ""
        self.answer: Answer | None = None
        self._client = client
        self._put = put
        self._over = REAL.event()
        self._renewer: Thread | None = None

    def __enter__(self) -> HeldDemand:
        """Put the demand, start to renew its lease if it has one, and return this object.

        The errors are those of :meth:`DemandClient.put`.
        """
        if lease_s := self._put_and_remember().lease_s:
            self._renewer = REAL.keep_running("lease", partial(self._renew_until_over, lease_s))
        return self

    def __exit__(self, kind: object, error: object, traceback: object) -> None:
        """Release the demand.

        If the block raised an error or the demand holds nothing, a failure is logged, not raised.

        Raises:
            DemandError: for any other failure, as in :meth:`DemandClient.release`.
        """
        self._over.set()
        if self._renewer is not None:
            self._renewer.join()
        try:
            self._client.release(self.id)
        except DemandError as problem:
            if kind is None and problem.code != "not-held":
                raise
            log.warning("demand %s was not released: %s", self.id, problem)

    def _put_and_remember(self) -> Answer:
        self.answer = self._put()
        self.commit = self.answer.commit
        return self.answer

    def _renew_until_over(self, lease_s: float) -> None:
        pause = lease_s * _RENEW_AFTER
        while not self._over.wait(pause):
            pause = lease_s * _RENEW_AFTER
            try:
                try:
                    self._client.renew(self.id)
                except DemandError as problem:
                    if problem.code != "not-held":
                        raise
                    self._put_and_remember()  # the lease ended while the network was down
            except DemandError as problem:
                log.warning("demand %s was not renewed: %s", self.id, problem)
                pause = min(pause, _RETRY_S)
