"""``demandops init``: makes a new state repo from the skeleton, with its rendered files."""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path

import pygit2

from demandops.base import strict_yaml
from demandops.base.addresses import as_git_url
from demandops.base.errors import StateRepoError
from demandops.base.settings import MAIN_BRANCH, RENDER_VERSION, SCHEMAS_ROOT, data_folder
from demandops.decide.state import State, rendered_files
from demandops.model.config.config import CONFIG_ROOTS
from demandops.model.config.load import load
from demandops.model.config.repo_settings import ROOT_FILE
from demandops.model.ledger.ledger import Ledger
from demandops.repo.git.objects import NewObjects
from demandops.repo.git.signing import Signer
from demandops.repo.history import commit_message
from demandops.templating.evaluator import EVALUATE

# ---- the files: the skeleton, the appdefs and the rendered files ----

EXAMPLE_URL = "https://git.example/fleet/state-repo.git"

_ENTRIES = re.compile(r"(?ms)^(clusters|nodes|brokers|charts):\n.*")


def files(gitops: str = "flux", url: str = EXAMPLE_URL, *, example: bool = True) -> dict[str, str]:
    """Return the files of a new state repo, as path → text.

    Clusters fetch the repo from ``url``; if it is empty, no cluster can fetch it yet. The example
    is the fleet and the application of the paper's experiment.
    """
    contents = _read_folder(data_folder("skeleton"), "")
    contents |= _read_folder(data_folder("appdefs"), "appdefs/")
    if not example:
        contents = _without_example(contents)
    roots = {"flux": contents.pop(ROOT_FILE), "argocd": contents.pop("demandops.argocd.yaml")}
    root = strict_yaml.set_key(roots[gitops], "renderVersion", RENDER_VERSION)
    if url:
        line = f"  url: {url if url == EXAMPLE_URL else strict_yaml.to_json(as_git_url(url))}"
        root = re.sub(r"(?m)^  url: .*$", lambda _: line, root)
    else:
        root = re.sub(r"(?m)^flux:\n  url: (.*)$", r"flux:\n  interval: 1m\n  # url: \1", root)
    contents[ROOT_FILE] = root
    config = load({p: text for p, text in contents.items() if p.split("/")[0] in CONFIG_ROOTS})
    return contents | rendered_files(State(config, Ledger(), EVALUATE))


def files_of_library(folder: str) -> dict[str, str]:
    appdefs = _read_folder(data_folder("appdefs"), "appdefs/")
    return {path: text for path, text in appdefs.items() if path.startswith(f"{folder}/")}


def _without_example(contents: Mapping[str, str]) -> dict[str, str]:
    files = {
        path: _ENTRIES.sub(r"\1: []\n", text).replace("charts: []", "charts: {}")
        if path.startswith(("inventory/", "registry/charts"))
        else text
        for path, text in contents.items()
        if not path.startswith("appdefs/object-detection-fusion/")
    }
    images = files["registry/images.yaml"]
    start, end = images.index("  object-detection:"), images.index("  # Zenoh connections")
    files["registry/images.yaml"] = images[:start] + images[end:]
    policy = "policy/access-domains.yaml"
    files[policy] = files[policy].replace("perception", "fleet")
    nodes, example = "inventory/nodes.yaml", " These are examples; replace them\n# with yours."
    files[nodes] = files[nodes].replace(example, "\n#")
    said = " `init` created an example with four vehicles, a station, an edge and a cloud server."
    files["README.md"] = files["README.md"].replace(said, "")
    return files


def _read_folder(folder: Path, prefix: str) -> dict[str, str]:
    return {
        prefix + path.relative_to(folder).as_posix(): path.read_text()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.suffix != ".pyc" and path.name != "__init__.py"
    }


# ---- the repository with its first commit ----

_WHY = "Why: `demandops init` made it from the skeleton; README.md says what each folder holds."
_FIRST_MESSAGE = commit_message.of_generator(
    [["Create the state repo"], [_WHY]], [("Operation", "init")]
)


def init(  # noqa: PLR0913 - what a state repo begins with
    target: Path,
    now: datetime,
    *,
    bare: bool,
    gitops: str,
    url: str = EXAMPLE_URL,
    example: bool = True,
    schemas: Mapping[str, str] | None = None,
    signer: Signer | None = None,
) -> str:
    """Make a state repo with the :func:`files`, and return its first commit, or make nothing.

    ``schemas`` are JSON Schemas by name. Raises InvalidInput if clusters cannot fetch from ``url``.
    """
    target = target.resolve()
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise StateRepoError(
            f"{target} exists and is not {'empty' if target.is_dir() else 'a folder'}; name a new "
            "folder (nothing was changed)"
        )
    content = files(gitops, url, example=example)
    content |= {f"{SCHEMAS_ROOT}/{name}.json": text for name, text in (schemas or {}).items()}
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        # so that a crash leaves no half of a state repo under the final name
        partial = target.with_name(f".{target.name}.partial")
        shutil.rmtree(partial, ignore_errors=True)
        try:
            repo = pygit2.init_repository(str(partial), bare=bare, initial_head=MAIN_BRANCH)
            repo.config["core.fsync"] = "committed"  # a push is on the disk when it is acknowledged
            repo.config["receive.fsckObjects"] = True  # refuse objects that libgit2 cannot read
            repo.config["gc.auto"] = 0  # because the generator joins the packs in the background
            objects = NewObjects(repo)
            who = commit_message.generator_signature(now)
            commit = objects.add_commit(
                signer, (who, who), _FIRST_MESSAGE, objects.add_tree(None, content), []
            )
            with objects.packed(commit):
                repo.references.create(f"refs/heads/{MAIN_BRANCH}", commit)
            if not bare:
                force = pygit2.enums.CheckoutStrategy.FORCE
                repo.checkout_head(strategy=force)  # type: ignore[no-untyped-call]
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
    return str(commit)
