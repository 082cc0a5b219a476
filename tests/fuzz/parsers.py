"""Every parser of input from outside: from people, vehicles, clusters and servers."""

from __future__ import annotations

import json
import os
import socket
import tempfile
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import click
import pygit2
import yaml
from application_manager_interfaces.action import DeploymentRequest
from demandops.base import strict_yaml
from demandops.base.errors import InvalidInput
from demandops.cli import target
from demandops.cli.actions.override import ends_at
from demandops.cluster.health import Target as ReleaseTarget
from demandops.cluster.health import health_reader
from demandops.decide.state import try_configuration
from demandops.detect import rule_file
from demandops.detect.detector import Detector, Want
from demandops.detect.observations import MessageReader, Observation, Unreadable
from demandops.detect.rule_file import RuleFile
from demandops.model.config import base_model, override
from demandops.model.config.load import load
from demandops.model.ledger import claim_file, records
from demandops.repo.forge import ForgeError, Gitea, GitHub
from demandops.repo.git import local_repository as addresses
from demandops.repo.history import commit_log, revisions
from demandops.repo.write import journal
from demandops.serve.http_server import PushWebhook
from demandops.serve.queue import ticket_from_journal
from demandops_interfaces.action import Demand
from demandops_ros import messages
from hypothesis import strategies as st

from tests.fuzz import Target
from tests.kit import detection, golden, rich
from tests.kit.cluster import Letters, condition, deployment
from tests.kit.config import state_of
from tests.kit.goals import EXPERIMENT
from tests.kit.memory import NOW
from tests.unit.cluster import test_argocd, test_flux
from tests.unit.demand.test_fuzz import ANYTHING, KEY, TEXT, assert_told, outcome

_PATHS = sorted(golden.GOLDEN.rglob("expected/**/*.yaml"))
_BOOKED = [path for path in _PATHS if "ledger" in path.parts]
_GOALS = [*EXPERIMENT, *golden.GOLDEN.glob("*/requests/*.yaml")]


def _text(data: bytes) -> str:
    return data.decode("utf-8", "replace")


def _bytes(paths: Iterable[Path], most: int = 20) -> tuple[bytes, ...]:
    """Return the distinct contents of the files, at most ``most`` of them."""
    return tuple(dict.fromkeys(path.read_bytes() for path in paths))[:most]


def _told(error: InvalidInput) -> None:
    """Check that each fault names a file and says something."""
    assert error.faults
    assert all(found.file and found.message for found in error.faults), error.faults


@cache
def _folder() -> Path:
    """Return a new folder, and make it the working directory of this process."""
    folder = Path(tempfile.mkdtemp(prefix="demandops-fuzz-"))
    os.chdir(folder)
    return folder


@cache
def _repo() -> pygit2.Repository:
    repo = pygit2.init_repository(str(_folder() / "repo.git"), bare=True, initial_head="main")
    who = pygit2.Signature("x", "x@example.org", 0, 0)
    repo.create_commit("refs/heads/main", who, who, "x", repo.TreeBuilder().write(), [])
    return repo


# ---- goals ----


def goal_as_yaml(data: bytes) -> None:
    for document in strict_yaml.load_all(_text(data), "goal.yaml"):
        goal_as_data(document)


def goal_as_data(data: Any) -> None:
    found = outcome(data)
    ours = ("kind", "apiVersion", "applications")
    of_reference = not isinstance(data, dict) or not any(str(key).startswith(ours) for key in data)
    if isinstance(found, tuple) and of_reference:
        assert_told(found)


def _goals() -> st.SearchStrategy[Any]:
    """Return a strategy for any data, and for valid goals in which parts are replaced."""
    models = [rich.reference_goal(), rich.own_goal()]
    return st.one_of(ANYTHING, *(_near(model, st.one_of(ANYTHING, TEXT)) for model in models))


def _near(value: Any, other: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    """Return a strategy for data near ``value``: parts are left out or replaced by ``other``."""
    same: st.SearchStrategy[Any] = st.just(value)
    if isinstance(value, dict):
        same = st.fixed_dictionaries({}, optional={k: _near(v, other) for k, v in value.items()})
    elif isinstance(value, list):
        same = (
            st.lists(st.one_of([_near(one, other) for one in value]), max_size=3) if value else same
        )
    return st.sampled_from(range(12)).flatmap(lambda number: same if number else other)


def _message(kind: Callable[[], Any]) -> st.SearchStrategy[Any]:
    """Return a strategy for messages of a type with any content."""
    known = {"string": TEXT.filter(str.isprintable), "boolean": st.booleans()}
    known |= {"double": st.floats(), "uint8": st.integers(0, 255)}
    known |= {"uint32": st.integers(0, 2**32 - 1), "int32": st.integers(-(2**31), 2**31 - 1)}
    fields = {}
    for name, type_name in kind().get_fields_and_field_types().items():
        inner = type_name.removeprefix("sequence<").rstrip(">")
        if inner not in known:
            package, message = inner.split("/")
            module = __import__(f"{package}.msg", fromlist=[message])
            known[inner] = _message(getattr(module, message))
        many = inner != type_name
        fields[name] = st.lists(known[inner], max_size=2) if many else known[inner]
    return st.fixed_dictionaries(fields).map(lambda values: kind(**values))


def ros_message(message: Any) -> None:
    own = isinstance(message, Demand.Goal)
    convert = messages.demand_goal_to_data if own else messages.message_to_data
    goal_as_data(convert(message))


def data_to_ros_message(data: Any) -> None:
    messages.demand_goal_from_data(data)


# ---- files of the state repo ----

_CONFIG = rich.rich()
_FILES = sorted(path for path in _CONFIG if "/charts/" not in path and "/values/" not in path)
_CHARTS = sorted(path for path in _CONFIG if "/charts/" in path or "/values/" in path)


def _seeds_of(paths: list[str]) -> tuple[bytes, ...]:
    return tuple(bytes([number]) + _CONFIG[path].encode() for number, path in enumerate(paths))


def config_file(data: bytes) -> None:
    try:
        load(_CONFIG | {_FILES[data[0] % len(_FILES)] if data else "": _text(data[1:])})
    except InvalidInput as error:
        _told(error)


def chart_file(data: bytes) -> None:
    _try({_CHARTS[data[0] % len(_CHARTS)] if data else "": _text(data[1:])})


def chart_values(file: tuple[str, Any]) -> None:
    _try({file[0]: json.dumps(file[1])})


def _try(changed: dict[str, str]) -> None:
    try:
        try_configuration(state_of(load(_CONFIG | changed)))
    except InvalidInput as error:
        _told(error)


def _changed_charts() -> st.SearchStrategy[tuple[str, Any]]:
    paths = [
        path for path in _CHARTS if path.endswith((".yaml", ".json")) and "/templates/" not in path
    ]
    files = [(path, yaml.safe_load(_CONFIG[path])) for path in paths]
    odd = ANYTHING.filter(_is_json)
    return st.one_of([st.tuples(st.just(path), _near(data, odd)) for path, data in files])


def _is_json(value: Any) -> bool:
    try:
        return bool(json.dumps(value, allow_nan=False))
    except (TypeError, ValueError):
        return False


def set_key(data: bytes) -> None:
    strict_yaml.set_key(_text(data), "renderVersion", 2)


def claim(data: bytes) -> None:
    text, path = _text(data), "ledger/applications/00/x/x.yaml"
    try:
        claim_file.read(text, path)
    except InvalidInput as error:
        _told(error)
        (found, *_) = error.faults
        if not found.message.startswith("the ids in this file belong to "):
            return
        path = found.message.removeprefix("the ids in this file belong to ").partition(";")[0]
    read = claim_file.read(text, path)
    assert claim_file.read(claim_file.text_of(read), path) == read
    assert read.lease is None or read.lease.has_ended(NOW) in (True, False)


def marker(data: bytes) -> None:
    records.read_ended_override({records.ended_override_path("x"): _text(data)})


def shutdown(data: bytes) -> None:
    records.read_all_shutdowns({records.shutdowns_path("0f" * 10): _text(data)})


def replicas(data: bytes) -> None:
    path = records.replicas_path(("replicas", "object-fusion", "edge", "", "", "", "", ""))
    record = records.read_replicas(_text(data), path)
    assert record is None or records.read_replicas(records.replicas_text(*record), path) == record


def waiting_demand(data: bytes) -> None:
    path = records.waiting_path("x")
    record = records.read_waiting(_text(data), path)
    if record is not None:
        assert records.read_waiting(records.waiting_text(record), path) == record
        goal_as_data(dict(record.goal))


# ---- files that only one person or one program reads ----


def contexts_file(data: bytes) -> None:
    os.environ["XDG_CONFIG_HOME"] = str(_folder())
    target.contexts_file().parent.mkdir(exist_ok=True)
    target.contexts_file().write_bytes(data)
    try:
        content = target.read_contexts()
    except InvalidInput as error:
        _told(error)
        return
    target.write_contexts(content)
    assert target.read_contexts() == content


def detector_rules(data: bytes) -> None:
    """Check that rules that can be read also compile, accept observations and form goals."""
    try:
        file = rule_file.read(_text(data), "rules.yaml")
    except InvalidInput as error:
        _told(error)
        return
    detector, wants = Detector(file, 0.0), list[Want]()
    for number, now in enumerate((0.0, 0.5, 2.0, 30.0, 1e5)):
        seen = [
            one
            for source in file.sources
            for entity in ("a", "b")
            for one in _seen(file, source, entity, now, number)
        ]
        wants += [want for _, want in detector.step(seen[:20], now)]
    wants += detector.replace_rules(file, 1e5, 1.0)
    for want in wants[:5]:
        if want.goal is not None:
            goal_as_data(want.goal)


def _seen(
    file: RuleFile, source: str, entity: str, now: float, number: int
) -> Iterable[Observation]:
    """Yield the observation from a message in which every field has the same value."""
    with suppress(Unreadable):
        yield MessageReader(file, source).observation(_Message(number * 3.0), entity, now)


class _Message(float):
    """A number that can be read as a message: ``message.a.b[0]`` is the number itself."""

    def __getattr__(self, name: str) -> _Message:
        return self

    def __getitem__(self, place: int) -> _Message:
        return self

    def __str__(self) -> str:
        return "entity"


def end_of_override(data: bytes) -> None:
    ends_at(_text(data))


_WAITING = b"""apiVersion: demandops.ledger/v2
kind: WaitingDemand
demand: x
request: x
requesters:
- vehicle00
since: "2026-01-31T12:00:00.000000Z"
priority: 5
goal:
  kind: Demand
  demand: x
  requesters: [vehicle00]
  applications:
  - id: x
    type: object-detection-fusion
    place: {role: edge}
    inputs: {ego_data: [{topic: /ego, source: vehicle00}]}
"""
_CONTEXTS = b"""apiVersion: demandops/v1
kind: Contexts
current: fleet
contexts:
  fleet: {stateRepo: https://git.example/fleet.git, clusters: /etc/clusters.yaml, signingKey: /k}
  other: {stateRepo: ../other}
"""
_SQUARE = [{"x": x, "y": y} for x, y in ((0, 0), (9, 0), (9, 9), (0, 9))]
_AREA = {"source": "cars", "polygon": _SQUARE}
_RULES = (
    Path(__file__).parents[2].joinpath("examples/experiment/rules.yaml").read_bytes(),
    *(
        detection.text_of(detection.rule("r", **condition)).encode()
        for condition in (
            {"near": {"source": "cars", "point": {"x": 1, "y": 2}, "start": 5, "stop": 9}},
            {"near": {**_AREA, "start": 5, "stop": 9}, "dwell": "1s", "retry": "5s"},
            {"together": {"source": "cars", "other": "bikes", "start": 5, "stop": 9}},
            {"count": {**_AREA, "start": 2, "stop": 1}},
            {
                "threshold": {
                    "source": "batteries",
                    "field": "percentage",
                    "below": 3,
                    "stop": 8,
                }
            },
            {"schedule": {"start": "06:00", "stop": "22:00", "days": ["mon"], "zone": "UTC"}},
        )
    ),
)
_MARKER = (
    b'apiVersion: demandops.ledger/v1\nkind: EndedOverride\noverride: x\nexpires: "2026-01-31T12:00'
    b':00Z"\n'
)
_REPLICAS = b"""apiVersion: demandops.ledger/v2
kind: KeptReplicas
service: object-fusion
node: edge
keeps:
- replicas: 3
  until: "2026-01-31T12:00:00.000000Z"
"""
_SHUTDOWN = b"""apiVersion: demandops.ledger/v2
kind: Shutdown
digest: 0f0f0f0f0f0f0f0f0f0f
request: x
requesters:
- vehicle00
at: "2026-01-31T12:00:00.000000Z"
"""


# ---- what the generator keeps, and Git ----

_PROPOSAL = {"branch": "demand/x", "commits": ["1" * 40], "base": "", "pushed": True, "link": ""}
_ENTRY = {
    "operation": "o",
    "goal": {"id": "x"},
    "received": "2026-01-31T12:00:00+00:00",
    "base": "",
}
_LINES = [_ENTRY, {"done": "o"}, _ENTRY | {"operation": "p", "proposal": _PROPOSAL}]


def journal_line(data: bytes) -> None:
    for entry in journal.parse(data, Path("journal")).values():
        ticket = ticket_from_journal(entry)
        assert ticket.received < NOW.replace(year=9999)
        assert [*journal.parse(journal._sealed([entry.record()], "")[0], Path())] == [
            entry.operation
        ]


def commit(data: bytes) -> None:
    repo = _repo()
    head = f"tree {repo.head.peel(pygit2.Tree).id}\n".encode()
    try:
        oid = repo.write(pygit2.enums.ObjectType.COMMIT, head + data)
        found = repo[oid]
    except pygit2.GitError:
        return  # the bytes are no commit
    entry = commit_log.entry_of(found)
    assert entry.by_generator in (True, False)
    commit_log.author_of(found)
    revisions.format_time(entry.time)


_COMMIT = b"""author petra <petra@example.org> 1769860800 +0100
committer DemandOps generator <generator@demandops.invalid> 1769860800 +0000

Join edge/fusion

Why: request 'x', received 2026-01-31.

Operation: join
Operation-Id: op-1
Requester: vehicle00
Render-Version: 1
"""


def address(data: bytes) -> None:
    _folder()
    text = _text(data)
    if addresses.is_url(text):
        addresses._check_url(text)
    else:
        addresses.connect(text, Path("data"))


def revision(data: bytes) -> None:
    repo = _repo()
    revisions.resolve(repo, repo.head.target, _text(data), NOW)
    revisions.parse_time(_text(data), NOW)


def moment(data: bytes) -> None:
    text = _text(data)
    for read, form in (
        (claim_file.parse_timestamp, claim_file.format_timestamp),
        (override.parse_time, override.format_time),
        (base_model.seconds_of, "{}s".format),
    ):
        with suppress(ValueError):
            found: Any = read(text)
            again = read(form(found)) if found != 0 else 0
            assert again == found, (found, again)


# ---- servers and clusters ----

_PULL = {"number": 1, "html_url": "https://x", "state": "open", "merged_at": None, "merged": False}


def forge_answer(data: bytes) -> None:
    try:
        answer = json.loads(data)
    except (ValueError, RecursionError):
        return  # the caller reports it
    for kind in (GitHub, Gitea):
        try:
            found = kind("https://x", "t", "o", "n")._read(answer)
        except ForgeError:
            continue
        assert found.link.isprintable()


@cache
def _webhook() -> tuple[PushWebhook, list[None]]:
    pushed: list[None] = []
    return PushWebhook("127.0.0.1:0", b"secret", lambda: pushed.append(None)), pushed


def webhook(data: bytes) -> None:
    server, pushed = _webhook()
    before = len(pushed)
    port = int(server.url.rsplit(":", 1)[1].split("/")[0])
    with socket.create_connection(("127.0.0.1", port), 5) as connection:
        try:
            connection.sendall(data)
            connection.shutdown(socket.SHUT_WR)
            answer = connection.makefile("rb").read()
        except OSError:
            answer = b""  # the server cut the connection
    assert answer[:10] in (b"", b"HTTP/1.1 2", b"HTTP/1.1 4"), answer[:80]
    assert len(pushed) == before or b"secret" in data or b"ignature" in data.title(), data


_PUSH = b"POST /push HTTP/1.1\r\nHost: x\r\nContent-Length: 2\r\nX-Gitlab-Token: %s\r\n\r\n{}"


def webhook_address(data: bytes) -> None:
    text = _text(data)
    if any(char.isalpha() for char in text):
        return  # a host name would be looked up
    PushWebhook(text, b"", lambda: None).close()


_READY = [condition("Ready", "True", "done"), condition("Ready", "False", "no")]
_OBJECTS: dict[Any, list[Any]] = {
    ("Kustomization", "ns", "perception"): [
        test_flux.kustomization("b", "b", one) for one in _READY
    ],
    ("GitRepository", "ns", "demandops"): [{"metadata": {}, "status": {"conditions": _READY[1:]}}],
    ("HelmRelease", "ns", "od-edge"): [test_flux.release(one) for one in _READY],
    ("Deployment", "ns", "od-edge"): [
        deployment("od-edge", condition("Progressing", "False"), of="od-edge", availableReplicas=1)
    ],
    test_argocd.OVER: [
        test_argocd.application(
            test_argocd.FOLDER, sync=sync, at="b", operation=test_argocd.synced(phase, "b", "m")
        )
        for sync, phase in (("Synced", "Succeeded"), ("OutOfSync", "Failed"))
    ],
    test_argocd.CHILD: [
        test_argocd.application(
            test_argocd.source(),
            sync="Synced",
            at="b",
            resources=({"kind": "Deployment", "namespace": "ns", "name": "od-edge"},),
            conditions=({"type": "SyncError", "message": "m"},),
            operation=test_argocd.synced(
                "Failed",
                "b",
                of=test_argocd.source(),
                resources=[{"kind": "Job", "name": "x", "status": "SyncFailed", "message": "m"}],
            ),
        )
    ],
}


def _reported(value: Any, *, is_top: bool = True) -> st.SearchStrategy[Any]:
    """Return a strategy for what an API may report instead of ``value``.

    In these values, parts are missing or null, and texts and numbers differ.
    """
    if isinstance(value, dict):
        parts = {key: _reported(inner, is_top=False) for key, inner in value.items()}
        if not is_top:
            return st.none() | st.fixed_dictionaries({}, optional=parts)
        every = {"metadata": parts.pop("metadata").map(lambda found: found or {})}
        return st.fixed_dictionaries(every, optional=parts)
    if isinstance(value, list):
        inner = [_reported(one, is_top=False).filter(lambda one: one is not None) for one in value]
        return st.none() | (st.lists(st.one_of(inner), max_size=2) if inner else st.just([]))
    if isinstance(value, bool | int):
        return st.none() | st.just(value) | st.integers(0, 3)
    return st.none() | st.just(value) | st.sampled_from(["", "a", "c"])


def cluster_objects(objects: dict[Any, Any]) -> None:
    for place in (test_flux.PLACE, test_argocd.PLACE):
        reader = health_reader(place)
        for is_service, wanted in ((True, True), (True, False), (False, True), (False, False)):
            target = ReleaseTarget(place, "od-edge", is_service=is_service, wanted=wanted)
            for judge in (reader.health, reader.release_health):
                found = judge(target, "b", objects, Letters())
                assert isinstance(found.reason, str)
            reader.last_transition(target, objects)
        reader.applied_commit(place, objects)


_ALL_OBJECTS = st.fixed_dictionaries(
    {}, optional={key: st.one_of(map(_reported, some)) for key, some in _OBJECTS.items()}
)
_TOLD = (ValueError, TypeError, AssertionError, AttributeError, OverflowError)

TARGETS = (
    Target(goal_as_yaml, _bytes(_GOALS)),
    Target(goal_as_data, values=_goals()),
    Target(ros_message, values=st.one_of(map(_message, (Demand.Goal, DeploymentRequest.Goal)))),
    Target(
        data_to_ros_message,
        values=_near(rich.own_goal(), ANYTHING) | st.dictionaries(KEY, ANYTHING),
        expected=_TOLD,
    ),
    Target(config_file, _seeds_of(_FILES)),
    Target(chart_file, _seeds_of(_CHARTS)),
    Target(chart_values, values=_changed_charts()),
    Target(set_key, tuple(_CONFIG[path].encode() for path in _FILES)),
    Target(claim, _bytes(path for path in _BOOKED if "shutdowns" not in path.parts)),
    Target(marker, (_MARKER,)),
    Target(shutdown, (_SHUTDOWN,)),
    Target(replicas, (_REPLICAS,)),
    Target(waiting_demand, (_WAITING,)),
    Target(contexts_file, (_CONTEXTS,)),
    Target(detector_rules, _RULES),
    Target(
        end_of_override,
        (b"2h", b"3d", b"1h30m", b"2027-01-31T18:00:00Z"),
        expected=(click.BadParameter,),
    ),
    Target(
        journal_line,
        (journal._sealed(_LINES, "")[0], *(json.dumps(one).encode() + b"\n" for one in _LINES)),
    ),
    Target(commit, (_COMMIT,)),
    Target(
        address,
        tuple(
            one.encode()
            for one in ("https://a:b@x.org/y.git", "ext::sh", "git@x.org:y", "~/x", "repo.git")
        ),
    ),
    Target(revision, (b"main~1", b"2h ago", b"2026-01-31T14:03Z", b"14:03", b"HEAD^{tree}")),
    Target(
        moment,
        (
            b"2026-01-31T12:00:00.000000Z",
            b"2026-01-31T12:00:00+01:00",
            b"1h30m",
            b"0001-01-01T00:00:00+23:59",
        ),
    ),
    Target(forge_answer, (json.dumps(_PULL).encode(),)),
    Target(webhook, (_PUSH % b"secret", _PUSH % b"x", b"GET / HTTP/1.1\r\nHost: x\r\n\r\n")),
    Target(webhook_address, (b"127.0.0.1:0", b"[::1]:0", b"0.0.0.0:80")),
    Target(cluster_objects, values=_ALL_OBJECTS),
)
