"""Configuration of a state repo: the skeleton's files, whole or with some of them changed."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml
from demandops.decide.state import State
from demandops.model.config.config import CONFIG_ROOTS, Config
from demandops.model.config.override import Override, OverrideFile
from demandops.model.ledger.ledger import Ledger
from demandops.repo.new_repo import files
from demandops.templating.values import evaluate


@lru_cache
def skeleton(gitops: str = "flux") -> Mapping[str, str]:
    return files(gitops)


def configuration(changed: Mapping[str, str | None] | None = None) -> dict[str, str]:
    """Return the skeleton's configuration with the ``changed`` files; ``None`` removes a file."""
    files: dict[str, str | None] = {
        path: text for path, text in skeleton().items() if path.split("/")[0] in CONFIG_ROOTS
    }
    files |= changed or {}
    return {path: text for path, text in files.items() if text is not None}


@lru_cache
def texts_below(folder: Path) -> dict[str, str]:
    """Return the texts of all files in a folder, by their paths in it."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_text() for path in files}


def state_of(config: Config, ledger: Ledger | None = None) -> State:
    """Return a state whose values are computed in this process."""
    return State(config, ledger or Ledger(), evaluate)


def edited(path: str, old: str, new: str) -> dict[str, str]:
    text = skeleton()[path]
    assert old in text, f"{path} does not contain {old!r}"
    return {path: text.replace(old, new, 1)}


def brokers(*nodes: str) -> dict[str, str]:
    entries = [{"node": node, "host": f"broker-{node}"} for node in nodes]
    head = {"apiVersion": "demandops/v1", "kind": "Brokers"}
    return {"inventory/brokers.yaml": yaml.safe_dump(head | {"brokers": entries})}


def override(*select: Mapping[str, Any], **fields: Any) -> str:
    head = {"apiVersion": "demandops/v1", "kind": "Override"}
    why = {"reason": "a field test", "owner": "petra"}
    return yaml.safe_dump(head | why | {"select": list(select)} | fields, sort_keys=False)


def override_of(name: str, *select: Mapping[str, Any], **fields: Any) -> Override:
    """Return what the file ``overrides/<name>.yaml`` of these fields means."""
    file = OverrideFile.model_validate(yaml.safe_load(override(*select, **fields)))
    return Override.from_file(name, file)
