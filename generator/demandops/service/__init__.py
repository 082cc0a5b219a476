"""The one use case: submit a demand, get a receipt when it is published.

One worker thread owns the state repo. Demands that arrive together are committed one by one and
published once; a lone one at once. Everything received is in the outbox first, so a crash loses
nothing, and when the remote has moved the demands themselves are judged again on the new tip.
"""

from demandops.service.generator import Generator
from demandops.service.ticket import Listener, Receipt, Stage, Ticket

__all__ = ["Generator", "Listener", "Receipt", "Stage", "Ticket"]
