"""Takes over the nodes that clusters have: when, and as one commit for all of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import inf

from demandops.base.errors import InvalidInput
from demandops.base.runtime import Runtime, log
from demandops.decide.discovery import ClusterNode, Discovered, discover
from demandops.decide.state import State
from demandops.model.config.config import NODES_FILE, Config
from demandops.model.config.discovered import DISCOVERED_ROOT, InvalidConfig, path_of
from demandops.repo.write.commit_batch import CommitBatch

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
        self._news_at, self._next_at, self._awaits_claims = inf, -inf, False
        self._told: frozenset[str] = frozenset()

    def has_news(self) -> None:
        self._news_at = min(self._news_at, self._runtime.monotonic())

    def due_in(self, state: State) -> float:
        now = self._runtime.monotonic()
        at = now if state.config is not self._config else self._news_at + _GATHER_S
        # claims on a node that is gone, or of a pattern until now, may end at any time
        at = min(at, self._next_at) if self._awaits_claims else at
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
        problems, unfit, may_leave = list[str](), dict[str, object](), True
        while True:
            found = _found(state, seen, texts, self._runtime, unfit, may_leave=may_leave)
            is_claimed = any(state.ledger.claims_needing(id) for id in unfit)
            self._awaits_claims = is_claimed or any(each.has_gone for each in found)
            problems = [problem for each in found for problem in each.problems]
            differing = [each for each in found if each.text != texts.get(each.path)]
            try:
                if differing:
                    # another look follows: what left here, another cluster may have
                    commits.take_over(differing, self._runtime.now())
                break
            except InvalidInput as error:
                new = (id for each in differing for id in each.new_ids)
                claimed = (id for id in new if state.ledger.claims_needing(id))  # of a pattern
                of_nodes: dict[str, object] = dict.fromkeys(claimed, error.faults[0])
                if isinstance(error, InvalidConfig):
                    of_nodes = error.of_nodes
                if of_nodes.keys() - unfit.keys():  # one node must not hold up the others
                    unfit |= of_nodes
                elif may_leave:  # people's files may name a node that is to leave; if so, all stay
                    may_leave = False
                    unfit.clear()
                else:
                    problems.append(f"the nodes of clusters stay as they are: {error.faults[0]}")
                    break
        for problem in sorted({*problems} - self._told):
            log.warning("%s", problem)
        self._told = frozenset(problems)


def _found(
    state: State,
    seen: Mapping[str, Sequence[ClusterNode]],
    texts: Mapping[str, str],
    runtime: Runtime,
    unfit: Mapping[str, object],
    *,
    may_leave: bool,
) -> list[Discovered]:
    config, now = state.config, runtime.now()
    files = {**config.entry_files[NODES_FILE]}

    def is_needed(id: str) -> bool:
        nodes = config.nodes_of(id)
        return not may_leave or any(state.ledger.claims_needing(node) for node in nodes)

    asked = {path_of(name): c for name, c in config.clusters.items() if c.nodes != "listed"}
    # files of clusters whose nodes are no longer taken over
    found = [Discovered(path, None) for path in sorted({*texts} - {*asked})]
    for path, cluster in asked.items():
        if cluster.name in seen:
            nodes = seen[cluster.name]
            before = texts.get(path)
            found.append(discover(cluster, nodes, before, now, files, unfit, is_needed))
            for id in found[-1].new_ids:  # another cluster may have it too, as new
                files.setdefault(id, path)
    return found
