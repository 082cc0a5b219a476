"""Every parser of input from outside: from people, vehicles, clusters and servers."""

from __future__ import annotations

import json
import os
import socket
import tempfile
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import pygit2
from application_manager_interfaces.action import DeploymentRequest
from demandops.base import strict_yaml
from demandops.base.errors import InvalidInput
from demandops.cli import target
from demandops.cli.changes.configure import ends_at
from demandops.cluster.health import ClusterDomain, ObjectSelector, health_reader
from demandops.cluster.health import Target as ReleaseTarget
from demandops.decide.state import try_configuration
from demandops.detect import rule_file
from demandops.detect.detector import Detector, Want
from demandops.detect.event_engine import Observation
from demandops.detect.message_reader import MessageReader, Unreadable
from demandops.model.config import base_model, override
from demandops.model.config.appdef import without_ignored_fields
from demandops.model.config.load import load
from demandops.model.ledger import claim as claim_files
from demandops.model.ledger import records
from demandops.repo.forge import ForgeError, Gitea, GitHub
from demandops.repo.git import remote_repository as addresses
from demandops.repo.history import commit_log, commit_message
from demandops.serve import journal
from demandops.serve.http_server import PushWebhook
from demandops_interfaces.action import Demand
from demandops_ros import messages
from hypothesis import strategies as st

from tests.fuzz import Target
from tests.golden import cases as golden
from tests.kit import forms, plain_yaml
from tests.kit.config import state_of
from tests.kit.goals import EXPERIMENT
from tests.kit.memory import NOW
from tests.unit.cluster.cases import Letters
from tests.unit.demand.test_refused import ANYTHING, KEY, TEXT, assert_told, outcome

_SEEDS = plain_yaml.beside(__file__, "seeds")
_BOOKED = sorted(golden.GOLDEN.rglob("expected/*/ledger/**/*.yaml"))
_GOALS = [*EXPERIMENT, *golden.GOLDEN.glob("*/requests/*.yaml")]


def _text(data: bytes) -> str:
    return data.decode("utf-8", "replace")


def _bytes(paths: Iterable[Path]) -> tuple[bytes, ...]:
    return tuple(dict.fromkeys(path.read_bytes() for path in paths))[:20]


@cache
def _folder() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="demandops-fuzz-"))
    os.chdir(folder)
    return folder


@cache
def bare_repo() -> pygit2.Repository:
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

_CONFIG = forms.rich()
_FILES = sorted(path for path in _CONFIG if "/charts/" not in path and "/values/" not in path)
_CHARTS = sorted(path for path in _CONFIG if "/charts/" in path or "/values/" in path)


def _seeds_of(paths: list[str]) -> tuple[bytes, ...]:
    return tuple(bytes([number]) + _CONFIG[path].encode() for number, path in enumerate(paths))


def config_file(data: bytes) -> None:
    load(_CONFIG | {_FILES[data[0] % len(_FILES)] if data else "": _text(data[1:])})


def chart_file(data: bytes) -> None:
    chart_values((_CHARTS[data[0] % len(_CHARTS)] if data else "", _text(data[1:])))


def chart_values(file: tuple[str, str]) -> None:
    try_configuration(state_of(load(_CONFIG | dict([file]))))


def _is_json(value: Any) -> bool:
    try:
        return bool(json.dumps(value, allow_nan=False))
    except (TypeError, ValueError):
        return False


_CHANGED_CHARTS = st.one_of([
    st.tuples(st.just(path), _near(plain_yaml.load(_CONFIG[path]), odd).map(json.dumps))
    for odd in [ANYTHING.filter(_is_json)]
    for path in _CHARTS
    if path.endswith((".yaml", ".json")) and "/templates/" not in path
])  # fmt: skip


def without_field(data: bytes) -> None:
    without_ignored_fields("appdefs/a/service.yaml", _text(data))


def set_key(data: bytes) -> None:
    strict_yaml.set_key(_text(data), "renderVersion", 2)


def claim(data: bytes) -> None:
    text, path = _text(data), "ledger/applications/00/x/x.yaml"
    try:
        claim_files.read(text, path)
    except InvalidInput as error:
        (found, *_) = error.faults
        if not found.message.startswith("the ids in this file belong to "):
            raise
        path = found.message.removeprefix("the ids in this file belong to ").partition(";")[0]
    read = claim_files.read(text, path)
    assert claim_files.read(claim_files.text_of(read), path) == read
    assert read.lease is None or read.lease.has_ended(NOW) in (True, False)


def marker(data: bytes) -> None:
    records.read_ended_override({records.ended_override_path("x"): _text(data)})


def waiting_demand(data: bytes) -> None:
    path = records.waiting_path("x")
    record = records.read_waiting(_text(data), path)
    if record is not None:
        assert records.read_waiting(records.waiting_text(record), path) == record
        goal_as_data(record.put.goal)


# ---- files that only one person or one program reads ----


def contexts_file(data: bytes) -> None:
    os.environ["XDG_CONFIG_HOME"] = str(_folder())
    target.contexts_file().parent.mkdir(exist_ok=True)
    target.contexts_file().write_bytes(data)
    content = target.read_contexts()
    target.write_contexts(content)
    assert target.read_contexts() == content


def detector_rules(data: bytes) -> None:
    """Check that rules that can be read also compile, accept observations and form goals."""
    file = rule_file.read(_text(data), "rules.yaml")
    detector, wants = Detector(file, 0.0), list[Want]()
    for number, now in enumerate((0.0, 0.5, 2.0, 30.0, 1e5)):
        seen = list[Observation]()
        for source, entity in product(file.sources, ("a", "b")):
            with suppress(Unreadable):
                message = _Message(number * 3.0)
                seen.append(MessageReader(file, source).observation(message, entity, now))
        wants += [want for _, want in detector.step(seen[:20], now)]
    wants += detector.replace_rules(file, 1e5, 1.0)
    for want in wants[:5]:
        if want.goal is not None:
            goal_as_data(want.goal)


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


# ---- what the generator keeps, and Git ----


def journal_line(data: bytes) -> None:
    for ticket in journal.parse(data, Path("journal")).values():
        assert ticket.received < NOW.replace(year=9999)
        (again,) = journal.parse(journal._sealed([ticket.as_data()], "")[0], Path()).values()
        assert again.as_data() == ticket.as_data()


def commit(data: bytes) -> None:
    repo = bare_repo()
    head = f"tree {repo.head.peel(pygit2.Tree).id}\n".encode()
    try:
        oid = repo.write(pygit2.enums.ObjectType.COMMIT, head + data)
        found = repo[oid]
    except pygit2.GitError:
        return  # the bytes are no commit
    entry = commit_log.entry_of(found)
    assert entry.by_generator in (True, False)
    commit_log.author_of(found)
    commit_message.time_text(entry.time)


def address(data: bytes) -> None:
    _folder()
    addresses.RemoteRepository = lambda *_, **more: None  # check a URL, but clone nothing
    addresses.connect(_text(data), Path("data"))


def revision(data: bytes) -> None:
    repo = bare_repo()
    commit_log.resolve(repo, repo.head.target, _text(data), NOW)
    commit_log.parse_time(_text(data), NOW)


def moment(data: bytes) -> None:
    text = _text(data)
    for read, form in (
        (base_model.parse_time, base_model.time_text),
        (base_model.parse_time, override.format_time),
        (base_model.seconds_of, "{}s".format),
    ):
        with suppress(ValueError):
            found: Any = read(text)
            again = read(form(found)) if found != 0 else 0
            assert again == found, (found, again)


# ---- servers and clusters ----


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


def webhook_address(data: bytes) -> None:
    text = _text(data)
    if any(char.isalpha() for char in text):
        return  # a host name would be looked up
    PushWebhook(text, b"", lambda: None).close()


_OBJECTS = {tuple(one["place"]): one["reported"] for one in _SEEDS["cluster-objects"]}
_PLACES = (
    ClusterDomain("c-its", "perception", "ns"),
    ClusterDomain(
        "c-its", "perception", "ns", ObjectSelector("Application", "argocd", "demandops-perception")
    ),
)


def _reported(value: Any, *, is_top: bool = True) -> st.SearchStrategy[Any]:
    """Return a strategy for objects with parts missing or null, or with other texts and numbers"""
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
    for place in _PLACES:
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
_LINES = [json.loads(line) for line in _SEEDS["journal-line"][0].splitlines()]
_RULES = Path(__file__).parents[2] / "examples/experiment/rules.yaml"
_GOAL_MODELS = (forms.reference_goal(), forms.own_goal())


def _seeds(check: Callable[[bytes], object]) -> tuple[bytes, ...]:
    return tuple(text.encode() for text in _SEEDS[check.__name__.replace("_", "-")])


TARGETS = (
    Target(goal_as_yaml, _bytes(_GOALS)),
    Target(
        goal_as_data,
        values=st.one_of(ANYTHING, *(_near(model, ANYTHING | TEXT) for model in _GOAL_MODELS)),
    ),
    Target(ros_message, values=st.one_of(map(_message, (Demand.Goal, DeploymentRequest.Goal)))),
    Target(
        data_to_ros_message,
        values=_near(forms.own_goal(), ANYTHING) | st.dictionaries(KEY, ANYTHING),
        expected=(ValueError, TypeError, AssertionError, AttributeError, OverflowError),
    ),
    Target(config_file, _seeds_of(_FILES), names_files=True),
    Target(chart_file, _seeds_of(_CHARTS), names_files=True),
    Target(chart_values, values=_CHANGED_CHARTS, names_files=True),
    *(
        Target(one, tuple(_CONFIG[path].encode() for path in _FILES))
        for one in (set_key, without_field)
    ),
    Target(claim, _bytes(_BOOKED), names_files=True),
    *(Target(one, _seeds(one)) for one in (marker, waiting_demand)),
    Target(contexts_file, _seeds(contexts_file), names_files=True),
    Target(detector_rules, (*_seeds(detector_rules), _RULES.read_bytes()), names_files=True),
    Target(end_of_override, _seeds(end_of_override), expected=(ValueError,)),
    Target(journal_line, (*_seeds(journal_line), journal._sealed(_LINES, "")[0])),
    *(Target(one, _seeds(one)) for one in (commit, address, revision, moment, forge_answer)),
    *(Target(one, _seeds(one)) for one in (webhook, webhook_address)),
    Target(cluster_objects, values=_ALL_OBJECTS),
)
