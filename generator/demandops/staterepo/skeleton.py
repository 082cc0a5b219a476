"""The files of a new state repo: the skeleton, the appdefs and the rendered files."""

from __future__ import annotations

import re
from pathlib import Path

from demandops import strict_yaml
from demandops.config.config import CONFIG_ROOTS
from demandops.config.load import load
from demandops.config.repo_settings import ROOT_FILE
from demandops.decision import State, rendered_files
from demandops.ledger.ledger import Ledger
from demandops.settings import RENDER_VERSION, data_folder


def files(gitops: str = "flux", url: str = "") -> dict[str, str]:
    """Return path → text of a new state repo; raise if clusters cannot fetch from ``url``."""
    contents = _read(data_folder("skeleton"), "")
    contents |= _read(data_folder("appdefs"), "appdefs/")
    roots = {"flux": contents.pop(ROOT_FILE), "argocd": contents.pop("demandops.argocd.yaml")}
    root = strict_yaml.set_key(roots[gitops], "renderVersion", RENDER_VERSION)
    if url:
        root = re.sub(r"(?m)^  url: .*$", lambda _: f"  url: {strict_yaml.to_json(url)}", root)
    contents[ROOT_FILE] = root
    config = load({p: text for p, text in contents.items() if p.split("/")[0] in CONFIG_ROOTS})
    return contents | rendered_files(State.of(config, Ledger()))


def _read(folder: Path, prefix: str) -> dict[str, str]:
    return {
        prefix + path.relative_to(folder).as_posix(): path.read_text()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.suffix != ".pyc" and path.name != "__init__.py"
    }
