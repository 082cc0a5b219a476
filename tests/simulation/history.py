"""A random history from a seed: thirty steps, then the mending of all faults, then a last check."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable
from datetime import timedelta
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory, mkdtemp
from typing import Any

import pygit2
from demandops.model.config.discovered import DISCOVERED_ROOT
from demandops.repo.git.repository import MAIN
from demandops.serve.agenda import LONGEST_WAIT_S

from tests.kit import plain_yaml, repo
from tests.kit.config import texts_below
from tests.kit.goals import connection, goal
from tests.kit.repo import GitRepo
from tests.model.goals import DemandMaker, Words
from tests.model.listed import Goal
from tests.model.running import DEFAULT, FIRST, FURTHER, HALL, NEXT, TALLY, Running
from tests.model.view import key_in_ledger
from tests.simulation.oracle import PLACES, SLACK_S, VISITOR, Oracle
from tests.simulation.world import MACHINE, RACK, World

STEPS = 30
STATE_REPO = Path(__file__).with_name("state-repo")
MEMORY = "/dev/shm"
NODES = "inventory/nodes/places.yaml"
APPDEF = "appdefs/object-detection-fusion/appdef.yaml"
VERSIONS = "registry/versions.yaml"
_OVERRIDES: dict[str, dict[str, object]] = {
    "more": {"select": [{"nodes": ["edge", "cloud"]}], "replicas": 2},
    "many": {"select": [{"nodes": ["edge"]}], "replicas": 3, "priority": 10},
    "closed": {"select": [{"connections": ["x"]}], "deny": True},
}
_LONGEST_LEASE_S = 90
WORDS = Words(
    demands=("d0", "d1", "D1", "d/2"),
    applications={"a": "edge", "b": "edge"},
    inputs=tuple(("ego_data", (f"/ego{number}", "vehicle00")) for number in (1, 2, 3)),
    # no other connection has its topics, so the model needs not know which one carries a topic
    connections={
        id: ("vehicle00", "edge", "", {f"/{id}{name}": f"/{id}{name}" for name in "pqr"})
        for id in "xy"
    },
    leases=(None, 10, 60, _LONGEST_LEASE_S),
)


@lru_cache(maxsize=1)
def template() -> Path:
    path = repo.init(Path(mkdtemp(dir=MEMORY, prefix="simulation-")) / "template.git")
    files = texts_below(STATE_REPO)
    appdef = plain_yaml.load(GitRepo(path).files(APPDEF)[APPDEF])
    appdef["services"]["object-fusion"]["requests"] = {"slots": 1}
    GitRepo(path).commit(files | {APPDEF: plain_yaml.dump(appdef)})
    repo.git(path, "repack", "-adq")
    return path


class History:
    def __init__(self, world: World) -> None:
        self.world, self.oracle = world, Oracle(world)
        self.chance, self.turns = world.turns.chance, world.turns
        self.repo = GitRepo(Path(world.remote.path))
        self._maker = DemandMaker(self.chance, WORDS)
        self._shutdowns: list[Goal] = []
        self._latest = 0.0
        self._sent: list[Goal] = []
        self._often, self._edited_often = self.chance.choice(
            [
                (self._tallied, self._delete_claim),
                (self._tallied, self._move_channel),
                *[(self._placed, self._drain)] * 2,
                (self._visitor, self._edit_generated),
                (self._any, self._delete_claim),
                (self._any, self._override),
                (self._message, self._delete_claim),
            ]
        )

    def run(self, steps: int) -> None:
        things = (
            [self.demand] * 15 + [self.rush] * 2 + [self.wait] * 4 + [self.edit] * 3
            + [self.decide] * 2 + [self.crash] * 2 + [self.spoil_network] * 3 + [self.set_clocks]
            + [self.withdraw] * 2 + [self.stop]
        )  # fmt: skip
        self.turns.sleep(1)
        for _ in range(steps):
            self.chance.choice(things)()
            self.turns.sleep(self.chance.choice([0, 0, 0.01, 0.2, 3]))
            for machine in self.world.machines:
                if not machine.is_up and self.chance.randrange(2):
                    machine.start()
            self.oracle.check()
        self.heal()
        self.oracle.check_end()

    def heal(self) -> None:
        """Mend all faults, decide all proposals, and wait until all leases are over."""
        for machine in self.world.machines:
            machine.is_cut_off, machine.delay = False, 0.0
            machine.crashes_in = machine.losses = machine.rejections = 0
            if not machine.is_up:
                machine.start()
        self.world.tell_nodes()
        self.turns.sleep(2 * LONGEST_WAIT_S)
        self.world.set_clocks(self._latest - self.turns.offset)
        self.turns.sleep(60)
        self._drain()
        for _ in range(3):
            while self._branches():
                self.decide()
            self.turns.sleep(30)
        # the waiting demands get the places one after the other
        self.turns.sleep(8 * (_LONGEST_LEASE_S + SLACK_S + LONGEST_WAIT_S))

    # ---- what happens ----

    def demand(self) -> None:
        self._send([self._goal() for _ in range(self.chance.choice([1, 1, 1, 2, 4]))])

    def rush(self) -> None:
        """Send two demands without a node; first release one that has a node."""
        held = [one for one in self.oracle.claims().values() if one.demand.startswith("place")]
        goals = [self._placed(), self._placed()]
        for claim in held[:1]:
            goals.insert(0, _named(claim.demand, [*claim.requesters]) | {"operation": "release"})
        self._send(goals)

    def _send(self, goals: list[Goal]) -> None:
        """Send demands to one machine; they become one batch if its generator is busy meanwhile."""
        ready = [machine for machine in self.world.machines if machine.generator]
        machine = self.chance.choice(ready) if ready else None
        for one in goals if machine else ():
            self._sent.append(one)
            self.oracle.ask(machine, one)

    def _goal(self) -> Goal:
        kind = self.chance.randrange(18)
        if kind > 10:
            return self._often()
        if kind == 10:
            return self._tallied()
        if kind == 0:
            return self._visitor()
        if kind == 1 and self._sent:  # sent again, as by a requester who got no answer
            return self.chance.choice(self._sent[-6:])
        if kind == 2:
            return self._message()
        if kind < 5:
            return self._placed()
        return self._any()

    def _any(self) -> Goal:
        kind = self.chance.randrange(20)
        if kind < DemandMaker.KINDS:
            return self._maker.any(kind)
        if kind == 19 and self._shutdowns:
            return self.chance.choice(self._shutdowns[-2:])
        return self._of_the_reference(shutdown=kind > 17)

    def _of_the_reference(self, *, shutdown: bool) -> Goal:
        """Return a goal of the reference's action for one connection."""
        id, people = self.chance.choice("xy"), DemandMaker.PEOPLE
        topics = [f"/{id}{name}" for name in self._maker.some("pq")]
        topics = topics if shutdown else topics or [f"/{id}p"]
        who = self._maker.some(people) or people[:1]
        item = connection(id, who=who, topics=topics, broker="")
        made = goal([], [item], id=self.chance.choice(["m0", "m1"]), shutdown=shutdown)
        self._shutdowns += [made] * shutdown
        return made

    def _message(self) -> Goal:
        """Return a goal of the reference's action, mostly for whom an earlier one joined."""
        made = self._of_the_reference(shutdown=bool(self.chance.randrange(2)))
        joins = [one for one in self._sent[-12:] if one.get("shutdown") is False]
        if joins and self.chance.randrange(3):
            (item,), known = made["connections"], self.chance.choice(joins)
            who = {name: known["connections"][0][name] for name in ("id", "requester_ids")}
            topics = [f"/{who['id']}{topic[-1]}" for topic in item["source_topics"]]
            who |= {"source_topics": topics, "target_topics": topics}
            made |= {"id": known["id"], "connections": [item | who]}
        return made

    def _tallied(self) -> Goal:
        """Return a put, release or renewal of a tally on the node that is in two access domains."""
        topics = self.chance.sample(range(4), self.chance.randrange(1, 5))
        inputs = {"ego_data": [{"topic": f"/e{one}", "source": "vehicle00"} for one in topics]}
        known = [one for one in self._sent if one.get("demand", "").startswith("tally")]
        puts = [one for one in known if one["operation"] == "put"]
        if puts and self.chance.randrange(3):  # mostly the same demand again
            (app,) = puts[-1]["applications"]
            again = app | {"inputs": inputs, "node": self.chance.choice([app["node"], HALL])}
            return puts[-1] | {"applications": [again]}
        number, names = self.chance.randrange(3), ["traffic", "vehicle01", "vehicle01", "vehicle00"]
        who = [["vehicle01"], ["vehicle01"], ["traffic", "vehicle01"]][number]
        if not self.chance.randrange(3):  # others, who may change nothing of these
            who = sorted({self.chance.choice(names), self.chance.choice(names)})
        made = _named(f"tally{number}", who)
        if puts and not self.chance.randrange(3):
            return made | {"operation": self.chance.choice(["release", "renew"])}
        app = _fusion(
            self.chance.choice(["hall0", "hall0", "hall0", "hall1", f"hall0@{NEXT}"]),
            type=TALLY,
            node=self.chance.choice([HALL, FIRST, FURTHER, FURTHER]),
            version=self.chance.choice(["", "", DEFAULT, NEXT, "testing"]),
            inputs=inputs,
        )
        return made | _put(app, self.chance.choice([None, None, None, 90]))

    def _placed(self) -> Goal:
        number = self.chance.randrange(4)
        who = [f"vehicle0{one}" for one in self.chance.choice([[0], [1], [0, 1]])]
        made = _named(f"place{number}", who)
        if not self.chance.randrange(3):
            return made | {"operation": self.chance.choice(["release", "release", "renew"])}
        made["priority"] = self.chance.choice([0, 0, 5])
        app = _fusion(f"place{number}", place={"role": "rack"})
        return made | _put(app, self.chance.choice([None, 10, 60, 90]))

    def _visitor(self) -> Goal:
        number = self.chance.randrange(3)
        made = self._maker.put()
        named = _named(f"visit{number}", [f"{VISITOR}{number}"])
        if not self.chance.randrange(4):
            return named | {"operation": self.chance.choice(["release", "renew"])}
        topics = [{"topic": f"/ego{self.chance.randrange(3)}", "source": "vehicle00"}]
        app = _fusion(f"visit{number}", node="edge", inputs={"ego_data": topics})
        return made | named | {"applications": [app], "connections": []}

    def wait(self) -> None:
        self.turns.sleep(self.chance.choice([0.1, 1, 10, 31, 61, 100, 200, 1000]))

    def withdraw(self) -> None:
        under_way = [one for one in self.oracle.asked.values() if one.is_under_way]
        if under_way:
            self.oracle.withdraw(self.chance.choice(under_way))

    def stop(self) -> None:
        machine = self.chance.choice(self.world.machines)
        if machine.generator:
            machine.stop(self.chance.choice([0, 0.2, 60]))

    def crash(self) -> None:
        machine = self.chance.choice(self.world.machines)
        self.oracle.counts["faults"] += machine.is_up
        if machine.is_up and self.chance.randrange(3):
            machine.crashes_in = self.chance.randrange(1, 15)
        elif machine.is_up:
            machine.crash()

    def spoil_network(self) -> None:
        machine = self.chance.choice(self.world.machines)
        kind = self.chance.randrange(7)
        self.oracle.counts["faults"] += kind < 5
        if kind < 2:
            machine.losses += self.chance.randrange(1, 4)
        elif kind == 2:
            machine.rejections += 1
        elif kind == 3:
            machine.is_cut_off = True
        elif kind == 4:
            machine.delay = self.chance.choice([0.02, 0.5, 5])
        else:
            machine.is_cut_off, machine.delay = False, 0.0
            self.world.tell_nodes()

    def set_clocks(self) -> None:
        """Set the wall clocks forward or back; after the first step back, only further back.

        A machine may notice neither of a step back and a step forward. The machine could then end a
        lease too early that another machine renewed between the steps.
        """
        self.oracle.check()
        self.oracle.counts["faults"] += 1
        sign = self.chance.choice([-1, 1]) if self.turns.offset == self._latest else -1
        self.world.set_clocks(sign * self.chance.choice([60, 600, 4000]))
        self._latest = max(self._latest, self.turns.offset)

    # ---- people ----

    def edit(self) -> None:
        edits = [self._override] * 2 + [self._inventory, self._drain, self._stop_waiting]
        edits += [self._move_channel, self._delete_claim] * 2
        self.chance.choice([*edits, self._edit_generated, *[self._edited_often] * 4])()

    def _commit(
        self, changed: dict[str, str | None], meant: Callable[[Running], object] = lambda _: None
    ) -> None:
        """Commit; ``meant`` makes the same change in the model."""
        who = ("Petra Platform", "petra@example.org", int(self.turns.now().timestamp()))
        self.oracle.edits[self.repo.commit(changed, "By hand\n", who)] = meant

    def _override(self) -> None:
        name = self.chance.choice(sorted(_OVERRIDES))
        path = f"overrides/{name}.yaml"
        if path in self.repo.files("overrides/") and self.chance.randrange(2):
            self._commit({path: None})
            return
        head = {"apiVersion": "demandops/v1", "kind": "Override"}
        file = head | {"reason": "For a test", "owner": "perception-team"} | _OVERRIDES[name]
        if seconds := self.chance.choice([None, 5, 100, 400]):
            end = self.turns.now().replace(microsecond=0) + timedelta(seconds=seconds)
            file["expires"] = end.isoformat().replace("+00:00", "Z")
        self._commit({path: plain_yaml.dump(file)})

    def _change(self, path: str, change: Callable[[Any], object], *meant: Any) -> None:
        data = plain_yaml.load(self.repo.files(path)[path])
        change(data)
        self._commit({path: plain_yaml.dump(data)}, *meant)

    def _inventory(self) -> None:
        car = {"type": "vehicle", "cluster": "c-its"}
        self._change(
            NODES, lambda data: data["nodes"].append(car | {"id": f"car{len(data['nodes'])}"})
        )

    def _drain(self) -> None:
        self.oracle.check()
        books = self.oracle.books
        used = sorted(PLACES - books.free() - books.drained) if self.chance.randrange(3) else []
        name = self.chance.choice(used or sorted(PLACES))
        if name == RACK:
            self._change_cluster()
            return
        drained = name not in books.drained

        def drain(data: Any) -> None:
            (node,) = (one for one in data["nodes"] if one["id"] == name)
            node["drained"] = drained

        self._change(NODES, drain, lambda books: books.drain(name, drained))

    def _change_cluster(self) -> None:
        """Cordon or uncordon the machine, take it out of the cluster, or bring it back."""
        machine = self.world.nodes.pop(RACK, None)
        if machine is None:
            self.world.nodes[RACK] = MACHINE
        elif self.chance.randrange(3):
            self.world.nodes[RACK] = machine._replace(is_cordoned=not machine.is_cordoned)
        self.world.tell_nodes()

    def _stop_waiting(self) -> None:
        self.oracle.check()
        if found := sorted(self.repo.files("ledger/waiting").items()):
            path, text = self.chance.choice(found)
            demand = plain_yaml.load(text)["goal"]["demand"]
            self._commit({path: None}, lambda books: books.waiting.pop(demand))

    def _move_channel(self) -> None:
        self.oracle.check()
        version = self.chance.choice([DEFAULT, NEXT])
        self._change(
            VERSIONS,
            lambda data: data["applications"][TALLY]["channels"].update(testing=version),
            lambda books: setattr(books, "testing", version),
        )

    def _delete_claim(self) -> None:
        self.oracle.check()
        found = sorted(self.oracle.claims().items())
        if found:
            path, claim = self.chance.choice(found)
            gone = self.oracle.key_of(key_in_ledger(claim.key))
            self._commit({path: None}, lambda books: books.drop([gone]))

    def _edit_generated(self) -> None:
        discovered = self.repo.files(DISCOVERED_ROOT)
        path = self.chance.choice(sorted({*self.repo.manifests(), *discovered}))
        self._commit({path: self.chance.choice([None, "hand: made\n"])})

    def _branches(self) -> list[str]:
        return sorted(b for b in self.world.remote.branches.local if b.startswith("demand/"))

    def decide(self) -> None:
        if not (branches := self._branches()):
            return
        remote, branch = self.world.remote, self.chance.choice(branches)
        self.oracle.decided.add(branch)
        self.oracle.check()
        ours, theirs = remote.references[MAIN].target, remote.branches[branch].target
        base = remote.merge_base(ours, theirs)
        if self.chance.randrange(3):
            self.oracle.approved.add(branch)
            if base == ours:
                remote.references.create(MAIN, theirs, force=True)
            elif base != theirs:
                index = remote.merge_trees(base, ours, theirs)
                if not index.conflicts:
                    time = int(self.turns.now().timestamp())
                    by = pygit2.Signature("Petra Platform", "petra@example.org", time, 0)
                    tree = index.write_tree(remote)
                    remote.create_commit(MAIN, by, by, "Merge\n", tree, [ours, theirs])
            self.oracle.check()
        remote.branches.delete(branch)


def _named(demand: str, who: list[str]) -> Goal:
    return {"kind": "Demand", "demand": demand, "requesters": who}


def _fusion(id: str, **more: Any) -> dict[str, Any]:
    inputs = {"ego_data": [{"topic": "/ego1", "source": "vehicle00"}]}
    app = {"id": id, "type": "object-detection-fusion", "connect": "none", "inputs": inputs}
    return app | more


def _put(app: dict[str, Any], lease: int | None) -> Goal:
    made = {"operation": "put", "applications": [app], "connections": []}
    return made | ({"lease": lease} if lease else {})


def play(seed: int, steps: int = STEPS) -> tuple[str, Counter[str]]:
    with TemporaryDirectory(dir=MEMORY, prefix="simulation-") as folder:
        world = World(seed, template(), Path(folder), machines=1 + seed % 3)
        history = History(world)
        with world.running():
            history.run(steps)
            counts = history.oracle.counts | Counter(demands=len(history.oracle.asked))
            return world.tip, counts


def clean_up() -> None:
    shutil.rmtree(template().parent)
    template.cache_clear()
