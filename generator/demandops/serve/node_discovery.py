"""Takes over the nodes that clusters have: when, and as one commit for all of them."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from math import inf

from demandops.base.errors import InvalidInput
from demandops.base.runtime import Runtime
from demandops.decide.discovery import ClusterNode, Discovered, discover
from demandops.decide.state import State
from demandops.model.config.config import NODES_FILE, Config
from demandops.model.config.discovered import DISCOVERED_ROOT, path_of
from demandops.repo.write.commit_batch import CommitBatch

log = logging.getLogger("demandops")

# All nodes of each cluster that was read, of those for which a configuration asks. It must return
# at once. A cluster that cannot be reached has the nodes that it last had.
NodesOf = Callable[[Config], Mapping[str, Sequence[ClusterNode]]]

# Who cordons a rack of machines does so one by one; they share a commit.
_GATHER_S = 5.0
# Between two looks at all nodes, and so between two commits.
_PAUSE_S = 60.0


class NodeDiscovery:
    """A part of the agenda. Any thread may call :meth:`has_news`."""

    def __init__(self, nodes_of: NodesOf, runtime: Runtime) -> None:
        self._nodes_of, self._runtime = nodes_of, runtime
        self._config: Config | None = None
        self._news_at, self._next_at, self._has_gone = inf, -inf, False
        self._told: frozenset[str] = frozenset()

    def has_news(self) -> None:
        self._news_at = min(self._news_at, self._runtime.monotonic())

    def due_in(self, state: State) -> float:
        now = self._runtime.monotonic()
        at = now if state.config is not self._config else self._news_at + _GATHER_S
        # claims on a node that is gone may end at any time
        at = min(at, self._next_at) if self._has_gone else at
        return max(0.0, max(at, self._next_at) - now)

    def commit_due(self, commits: CommitBatch) -> None:
        state = commits.head.state
        if self.due_in(state):
            return
        self._config, self._news_at = state.config, inf  # before the nodes are read: news may come
        seen, texts = self._nodes_of(state.config), commits.texts(DISCOVERED_ROOT)
        if not seen and not texts:
            return
        self._next_at = self._runtime.monotonic() + _PAUSE_S
        if commits.head.faults:  # an earlier configuration is in effect, as a whole
            self.has_news()
            return
        problems, failure = list[str](), None
        # what people wrote may name a node that is to leave; if so, all stay
        for may_leave in (True, False):
            found = _found(state, seen, texts, self._runtime, may_leave=may_leave)
            self._has_gone = any(each.has_gone for each in found)
            problems = [problem for each in found for problem in each.problems]
            differing = [each for each in found if each.text != texts.get(each.path)]
            try:
                if differing:
                    commits.take_over(differing, self._runtime.now())
                    self._config = commits.head.state.config
                break
            except InvalidInput as error:
                failure = f"the nodes of clusters stay as they are: {error.faults[0]}"
        else:
            problems.append(failure or "")
        for problem in sorted({*problems} - self._told):
            log.warning("%s", problem)
        self._told = frozenset(problems)


def _found(
    state: State,
    seen: Mapping[str, Sequence[ClusterNode]],
    texts: Mapping[str, str],
    runtime: Runtime,
    *,
    may_leave: bool,
) -> list[Discovered]:
    config, now = state.config, runtime.now()
    files = config.entry_files[NODES_FILE]

    def is_needed(id: str) -> bool:
        nodes = config.nodes_of(id)
        return not may_leave or any(state.ledger.claims_needing(node) for node in nodes)

    asked = {path_of(name): c for name, c in config.clusters.items() if c.nodes != "listed"}
    # files of clusters whose nodes are no longer taken over
    found = [Discovered(path, None) for path in sorted({*texts} - {*asked})]
    for path, cluster in asked.items():
        if cluster.name in seen:
            nodes = seen[cluster.name]
            found.append(discover(cluster, nodes, texts.get(path), now, files, is_needed))
    return found
