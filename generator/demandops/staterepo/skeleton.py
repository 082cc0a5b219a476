"""The files of a new state repo: the skeleton, the appdefs and the rendered files."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from demandops import strict_yaml
from demandops.config.config import CONFIG_ROOTS
from demandops.config.load import load
from demandops.config.repo_settings import ROOT_FILE, as_git_url
from demandops.decision import State, rendered_files
from demandops.evaluator.process import EVALUATE
from demandops.ledger.ledger import Ledger
from demandops.settings import RENDER_VERSION, data_folder

EXAMPLE_URL = "https://git.example/fleet/state-repo.git"

_ENTRIES = re.compile(r"(?ms)^(clusters|nodes|brokers|charts):\n.*")
_EXPERIMENT = "appdefs/object-detection-fusion/"
_FIRST_STEP = (
    " `init` created an example with four vehicles, a station, an edge and a cloud server."
)


def files(gitops: str = "flux", url: str = EXAMPLE_URL, *, example: bool = True) -> dict[str, str]:
    """Return the files of a new state repo, as path → text.

    Args:
        gitops: the GitOps controller, ``flux`` or ``argocd``.
        url: the URL from which clusters fetch the repo; if empty, no cluster can fetch it yet.
        example: whether to include the fleet and the application of the paper's experiment.
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
    """Return the files of the library chart that ``init`` puts into ``folder``, as path → text."""
    appdefs = _read_folder(data_folder("appdefs"), "appdefs/")
    return {path: text for path, text in appdefs.items() if path.startswith(f"{folder}/")}


def _without_example(contents: Mapping[str, str]) -> dict[str, str]:
    files = {
        path: _ENTRIES.sub(r"\1: []\n", text).replace("charts: []", "charts: {}")
        if path.startswith(("inventory/", "registry/charts"))
        else text
        for path, text in contents.items()
        if not path.startswith(_EXPERIMENT)
    }
    images = files["registry/images.yaml"]
    start, end = images.index("  object-detection:"), images.index("  # Zenoh connections")
    files["registry/images.yaml"] = images[:start] + images[end:]
    policy = "policy/access-domains.yaml"
    files[policy] = files[policy].replace("perception", "fleet")
    nodes, example = "inventory/nodes.yaml", " These are examples; replace them\n# with yours."
    files[nodes] = files[nodes].replace(example, "\n#")
    files["README.md"] = files["README.md"].replace(_FIRST_STEP, "")
    return files


def _read_folder(folder: Path, prefix: str) -> dict[str, str]:
    return {
        prefix + path.relative_to(folder).as_posix(): path.read_text()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.suffix != ".pyc" and path.name != "__init__.py"
    }
