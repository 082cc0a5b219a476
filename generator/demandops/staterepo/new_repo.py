"""``demandops init``: makes a new state repo from the skeleton, with its rendered files."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path

import pygit2

from demandops.errors import StateRepoError
from demandops.settings import MAIN_BRANCH, RENDER_VERSION, SCHEMAS_ROOT
from demandops.staterepo import skeleton
from demandops.staterepo.git import signing
from demandops.staterepo.git import tree as trees
from demandops.staterepo.git.new_objects import NewObjects
from demandops.staterepo.git.signing import Signer
from demandops.staterepo.history import commit_message, message_format


def init(  # noqa: PLR0913 - what a state repo begins with
    target: Path,
    now: datetime,
    *,
    bare: bool,
    gitops: str,
    url: str = skeleton.EXAMPLE_URL,
    example: bool = True,
    schemas: Mapping[str, str] | None = None,
    signer: Signer | None = None,
) -> str:
    """Make a state repo and return the id of its first commit, or make nothing.

    Args:
        target: the folder of the state repo; it must be empty or not exist.
        bare: whether to make a bare repository, which the generator can use in place.
        gitops: the GitOps controller, ``flux`` or ``argocd``.
        url: the URL from which clusters fetch the repo; if empty, no cluster can fetch it yet.
        example: whether to include the fleet and the application of the paper's experiment.
        schemas: name → JSON Schema, which is written to the folder ``schemas/``.
        signer: signs the first commit.

    Raises InvalidInput if clusters cannot fetch from ``url``.
    """
    target = target.resolve()
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise StateRepoError(
            f"{target} exists and is not {'empty' if target.is_dir() else 'a folder'}; name a new "
            "folder (nothing was changed)"
        )
    content = skeleton.files(gitops, url, example=example)
    content |= {f"{SCHEMAS_ROOT}/{name}.json": text for name, text in (schemas or {}).items()}
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        # so that a crash leaves no half of a state repo under the final name
        partial = target.with_name(f".{target.name}.partial")
        shutil.rmtree(partial, ignore_errors=True)
        try:
            commit = _write(partial, content, now, bare, signer)
            if target.exists():  # keep the folder, because a shell may be in it
                for part in partial.iterdir():
                    part.rename(target / part.name)
            else:
                partial.rename(target)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    except (OSError, pygit2.GitError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise StateRepoError(f"{target} cannot be made: {reason}; name another folder") from None
    return commit


def _write(
    folder: Path, content: Mapping[str, str], now: datetime, bare: bool, signer: Signer | None
) -> str:
    repo = pygit2.init_repository(str(folder), bare=bare, initial_head=MAIN_BRANCH)
    repo.config["core.fsync"] = "committed"  # a push is on the disk when it is acknowledged
    repo.config["receive.fsckObjects"] = True  # refuse objects that libgit2 cannot read
    repo.config["gc.auto"] = 0  # because the generator joins the packs in the background
    objects = NewObjects(repo)
    tree = trees.write(objects, None, content)
    why = "Why: `demandops init` made it from the skeleton; README.md says what each folder holds."
    trailers = [("Operation", "init"), ("Render-Version", str(RENDER_VERSION))]
    text = message_format.compose([["Create the state repo"], [why]], trailers)
    signature = commit_message.generator_signature(now)
    commit = signing.create_commit(objects, signer, (signature, signature), text, tree, [])
    with objects.packed(commit):
        repo.references.create(f"refs/heads/{MAIN_BRANCH}", commit)
    if not bare:
        repo.checkout_head(  # type: ignore[no-untyped-call]
            strategy=pygit2.enums.CheckoutStrategy.FORCE
        )
    return str(commit)
