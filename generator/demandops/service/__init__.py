"""The generator as a service: submit a demand and get a receipt once it is published.

Any thread may submit a demand. One thread journals the demands that arrive. One worker thread owns
the state repo: it commits each demand and publishes the commits together. After a crash, the next
start resumes the demands in the journal.
"""

from demandops.service.generator import Generator
from demandops.service.ticket import Listener, Receipt, Stage, Ticket

__all__ = ["Generator", "Listener", "Receipt", "Stage", "Ticket"]
