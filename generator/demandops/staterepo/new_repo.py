"""``demandops init``: a new state repo from the skeleton, rendered once."""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path

import pygit2

from demandops import strict_yaml
from demandops.config.config import CONFIG_ROOTS
from demandops.config.load import load
from demandops.config.repo_settings import ROOT_FILE
from demandops.decision import State, rendered_files
from demandops.errors import StateRepoError
from demandops.ledger.ledger import Ledger
from demandops.settings import MAIN_BRANCH, RENDER_VERSION, data_folder
from demandops.staterepo.git import signing
from demandops.staterepo.git import tree as trees
from demandops.staterepo.git.signing import Signer
from demandops.staterepo.history import commit_message

PIPELINES = (".github/workflows/demandops.yml", ".gitlab-ci.yml")
"""The pipelines that check pull requests, on GitHub and GitLab."""


def files(gitops: str = "flux", url: str = "") -> dict[str, str]:
    """Return path → text of a new state repo: skeleton, appdefs and their rendered files.

    Raises:
        InvalidInput: clusters cannot fetch from ``url``.
    """
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


def init(
    target: Path,
    now: datetime,
    *,
    bare: bool,
    gitops: str,
    url: str = "",
    signer: Signer | None = None,
) -> str:
    """Make a state repo and return its first commit.

    Args:
        target: a folder that does not exist or is empty.
        now: the time of the commit.
        bare: make a bare repository, which the generator can use in place.
        gitops: the GitOps controller, ``flux`` or ``argocd``.
        signer: signs the commit, if given.
        url: the URL that the clusters fetch from; by default the skeleton's example.

    Raises:
        StateRepoError: the folder is not empty; nothing is written.
    """
    target = target.resolve()
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise StateRepoError(
            f"{target} exists and is not empty; name a new folder (nothing was changed)"
        )
    content = files(gitops=gitops, url=url)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        partial = target.with_name(f".{target.name}.partial")
        shutil.rmtree(partial, ignore_errors=True)
        try:
            commit = _write(partial, content, now, bare, signer)
            if target.exists():
                target.rmdir()
            partial.rename(target)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    except OSError as error:
        reason = error.strerror or str(error)
        raise StateRepoError(f"{target} cannot be made: {reason}; name another folder") from None
    return commit


def _write(
    folder: Path, content: Mapping[str, str], now: datetime, bare: bool, signer: Signer | None
) -> str:
    repo = pygit2.init_repository(str(folder), bare=bare, initial_head=MAIN_BRANCH)
    repo.config["core.fsync"] = "committed"  # a push is on the disk when it is acknowledged
    tree = trees.write(repo, None, content)
    text = (
        "Create the state repo\n\n"
        "Why: `demandops init` made it from the skeleton; README.md says what each folder holds."
        "\n\n"
        f"Operation: init\nRender-Version: {RENDER_VERSION}\n"
    )
    signature = commit_message.generator_signature(now)
    commit = signing.create_commit(repo, signer, (signature, signature), text, tree, [])
    repo.references.create(f"refs/heads/{MAIN_BRANCH}", commit)
    if not bare:
        repo.checkout_head(  # type: ignore[no-untyped-call]
            strategy=pygit2.enums.CheckoutStrategy.FORCE
        )
    return str(commit)
