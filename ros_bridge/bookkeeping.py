"""The service ``GetBookkeeping``: who requests what, over ROS 2, as the command line prints it."""

from __future__ import annotations

import json
from typing import Any

from generator.errors import DemandOpsError
from generator.plan.bookkeeping import as_data, bookkeeping
from generator.service import Generator
from generator.staterepo import reader


def answer(generator: Generator, request: Any, response: Any) -> Any:  # noqa: ANN401
    """Fill the response with the bookkeeping at ``request.at``; the newest where it is empty."""
    try:
        if request.at:
            with reader.opened(generator.given_address) as repo:
                snapshot = repo.snapshot(request.at)
        else:
            snapshot = generator.snapshot
        books = bookkeeping(snapshot.state.ledger, snapshot.state.catalog)
    except DemandOpsError as error:
        response.ok, response.message = False, str(error)
        return response
    response.ok = True
    response.commit = str(snapshot.commit)
    response.bookkeeping_json = json.dumps(as_data(books, response.commit), ensure_ascii=False)
    return response
