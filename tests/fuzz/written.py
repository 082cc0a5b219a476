"""A value that the program writes as text is still the same when another program reads it.

Claims, names, texts in YAML and commit messages have tests with random values in ``tests/unit``.
"""

from __future__ import annotations

import copy
import json
import re
import subprocess
from contextlib import suppress
from datetime import datetime
from pathlib import PurePosixPath
from random import Random
from typing import Any

import pyjson5
import yaml
from demandops.base import strict_yaml
from demandops.base.errors import InvalidInput
from demandops.cli.changes.configure import selector
from demandops.decide.state import try_configuration
from demandops.model.config import base_model
from demandops.model.config.load import load
from demandops.model.config.override import Override, OverrideFile
from demandops.model.demand.goals import _value_problem
from demandops.repo.history import commit_log, commit_message
from demandops.repo.write.proposal_branch import branch_name
from demandops.serve import proposal
from hypothesis import strategies as st

from tests.fuzz import Target
from tests.fuzz.parsers import bare_repo
from tests.kit import forms, plain_yaml
from tests.kit.config import state_of
from tests.kit.memory import MemoryRepo
from tests.kit.plain_yaml import FAST
from tests.unit.ledger.test_claim_file import TRICKY, values
from tests.unit.render.test_inert import TRAPS, UNSEEN
from tests.unit.repo.test_commit_messages import IDS

_ODD_NAMES = ["../x", "/x", ".git", "a.lock", "-x", "--x=y", "@{", "a~b", "a" * 300]
_SOME = [*TRAPS, *UNSEEN, *TRICKY, *_ODD_NAMES]
TEXT = st.text(st.characters(codec="utf-8"), max_size=40) | st.sampled_from(_SOME)
_LABEL = re.compile(r"([A-Za-z0-9]([A-Za-z0-9_.-]{0,61}[A-Za-z0-9])?)?")
_LABEL_KEY = re.compile(
    r"([a-z0-9][a-z0-9.-]{0,252}/)?[A-Za-z0-9]([A-Za-z0-9_.-]{0,61}[A-Za-z0-9])?"
)
_SUBDOMAIN = re.compile(r"[a-z0-9]([-a-z0-9.]{0,251}[a-z0-9])?")
_LAUNCH = re.compile(r"node_name:=[a-z0-9_]+|__node:=[a-z0-9_]+")


# ---- rendered files ----


def _filled(given: tuple[int, list[str]]) -> tuple[dict[str, str], Any]:
    """Return a rich configuration and a goal in which the given texts replace some texts."""
    seed, texts = given
    random, files, goal = Random(seed), forms.rich(), forms.own_goal()
    name = random.choice([path for path in files if path.startswith(("inventory", "registry"))])
    data = plain_yaml.load(files[name])
    renamed = {old: random.choice(texts) for old in ("vehicle00", "edge") if random.random() < 0.3}
    for document in (data, goal):
        for *above, key in [*forms.places(document)]:
            holder = forms.at(document, tuple(above))
            if isinstance(holder[key], str) and random.random() < 0.05:
                holder[key] = random.choice(texts)
    files[name] = yaml.safe_dump(data, allow_unicode=True)
    for old, new in renamed.items():  # an id is renamed everywhere
        goal = _renamed(goal, old, new)
        for path in files:
            if path.startswith("inventory/"):
                whole = _renamed(plain_yaml.load(files[path]), old, new)
                files[path] = yaml.safe_dump(whole, allow_unicode=True)
    goal["connections"][0]["type"] = random.choice(["mqtt", "zenoh", "ros"])
    return files, goal


def _renamed(data: Any, old: str, new: str) -> Any:
    return json.loads(json.dumps(data).replace(json.dumps(old), json.dumps(new)))


def rendered_file(given: tuple[dict[str, str], Any]) -> None:
    files, goal = given
    state = state_of(load(files))
    try_configuration(state)
    books = MemoryRepo(state=state)
    for asked in (goal, {**copy.deepcopy(goal), "applications": [], "demand": "b"}):
        with suppress(InvalidInput):
            books.send(asked)
    for path, text in books.files.items():
        _below_its_folder(path)
        for document in yaml.load_all(text, Loader=FAST):
            _fits_kubernetes(document)


def _fits_kubernetes(document: Any) -> None:
    metadata = document.get("metadata") or {}
    pod = (document.get("spec") or {}).get("template") or {}
    for labels in (metadata.get("labels"), (pod.get("metadata") or {}).get("labels")):
        for key, value in (labels or {}).items():
            assert _LABEL_KEY.fullmatch(key) and _LABEL.fullmatch(value), (key, value)
    if "name" in metadata and document.get("kind") != "ClusterRoleBinding":
        assert _SUBDOMAIN.fullmatch(metadata["name"]), metadata["name"]
    for name, content in (document.get("data") or {}).items():
        if name.endswith((".yaml", ".json5")):
            assert isinstance(plain_yaml.load(content), dict), content
        if name.endswith(".json5"):
            assert pyjson5.decode(content) == json.loads(content)
    for container in (pod.get("spec") or {}).get("containers") or ():
        for word in container.get("args") or ():
            assert isinstance(word, str) and word.isprintable(), word
            is_argument = ":=" in word and not word.startswith("params_file")
            assert not is_argument or _LAUNCH.fullmatch(word), word


def _below_its_folder(path: str) -> None:
    parts = PurePosixPath(path).parts
    assert str(PurePosixPath(path)) == path and path.isascii() and path.isprintable(), path
    assert not {"..", ".", ".git", "/"} & {part.lower() for part in parts}, path
    assert all(len(part) <= 255 for part in parts), path


def override_by_command(words: tuple[str, str, list[str], Any]) -> None:
    """Check that the command refuses what a person gives, or writes all of it to the override."""
    reason, owner, nodes, patch = words
    wanted = {
        "reason": " ".join(reason.split()) or "x",
        "owner": owner or "x",
        "values": patch,
        "select": [selector({"node": (*nodes,)})],
    }
    text = base_model.document("overrides/x.yaml", "override", "Override", wanted)
    data = strict_yaml.load(text)
    assert {key: data[key] for key in wanted} == wanted
    assert text.startswith("# yaml-language-server: ") and plain_yaml.load(text) == data
    Override.from_file("x", base_model.parse_file(OverrideFile, text, "overrides/x.yaml"))


# ---- Git and forges ----


def author_in_git(words: tuple[str, str, datetime]) -> None:
    name, email, time = words
    repo, who = bare_repo(), commit_message.signature(name, email, time)
    oid = repo.create_commit(None, who, who, "x", repo.TreeBuilder().write(), [])
    lines = repo[oid].read_raw().split(b"\n\n")[0].split(b"\n")
    assert [line.split(b" ")[0] for line in lines] == [b"tree", b"author", b"committer"]
    assert re.fullmatch(rb"author [^<>\0]+ <[^<>\0 ]+> -?\d+ [+-]\d{4}", lines[1]), lines[1]
    assert commit_log.author_of(repo[oid]) == (who.name, who.email)


def branch(words: tuple[str, str]) -> None:
    name = branch_name(*words)
    command = ["git", "check-ref-format", "--branch", name]
    assert subprocess.run(command, capture_output=True, check=False).returncode == 0, name


def pull_request(words: tuple[str, list[str]]) -> None:
    message, reasons = words
    options = proposal.push_options(message, reasons)
    assert all("\n" not in one for one in options)
    body = proposal.pull_request_texts(message)[1]
    head = body.partition("`" * 3)[0]
    inside = body[len(head) :].split("\n")
    closing = [number for number, line in enumerate(inside) if line == inside[-2]]
    assert closing == [len(inside) - 2], body


_PAIR = st.tuples(TEXT, TEXT)
_PATCH = st.dictionaries(TEXT, values, max_size=3).filter(lambda one: not _value_problem(one, 0))

_NODES = st.lists(TEXT, min_size=1, max_size=2)
_TEXTS = st.lists(TEXT, min_size=1, max_size=3)

TARGETS = (
    Target(rendered_file, values=st.tuples(st.integers(), _TEXTS).map(_filled)),
    Target(override_by_command, values=st.tuples(TEXT, TEXT, _NODES, _PATCH)),
    Target(author_in_git, values=st.tuples(TEXT, TEXT, st.datetimes())),
    Target(branch, values=_PAIR),
    Target(pull_request, values=st.tuples(TEXT, st.lists(IDS, max_size=2))),
)
