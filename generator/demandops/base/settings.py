"""Constants of the program, and the locations of the program's own files.

The versions below are written in the files of a state repo. A generator refuses a file whose format
it does not know, and a state repo with another render version.
"""

from __future__ import annotations

import hashlib
import os
from contextlib import suppress
from pathlib import Path
from typing import Final

from demandops.base.errors import StateRepoError

# `apiVersion` of every configuration file
API_VERSION: Final = "demandops/v1"

# `apiVersion` of every claim file
LEDGER_API_VERSION = "demandops.ledger/v3"

# The version of rendering. It is increased whenever the same ledger and configuration render to
# other bytes than before.
RENDER_VERSION = 3

# The branch that Flux and Argo CD read and the generator writes
MAIN_BRANCH = "main"

# The action that the reference's clients send goals to (robotkube's event detector)
DEFAULT_ACTION_NAME = "/event_detector_operator_plugin/operator_plugin/deployment_request"

# The action that our own clients send goals to
DEFAULT_DEMAND_ACTION_NAME = "/demandops/demand"

# How many demands may be queued; a further demand is rejected
QUEUE_LIMIT = 10_000

# How many demands of one requester may have no answer yet; a further demand is rejected. Demands
# that await approval do not count.
REQUESTER_QUEUE_LIMIT = 1_000

# How many proposals of one requester may await approval. A demand that needs a further proposal is
# refused.
PROPOSAL_LIMIT = 100

# The top-level folders whose files are all rendered from ledger and configuration
GENERATED_ROOTS = ("bootstrap", "clusters")

# The folder for JSON Schemas in each state repo; editors read the schemas
SCHEMAS_ROOT = "schemas"


def modeline(path: str, schema: str) -> str:  # with it, editors check a file with a schema
    up = "../" * path.count("/")
    return f"# yaml-language-server: $schema={up}{SCHEMAS_ROOT}/{schema}.json\n"


# Where the second version listed the files that were not valid; `demandops upgrade` removes it.
REPORTS_ROOT = ".demandops"

_PACKAGE = Path(__file__).parents[1]
_CHECKOUT = _PACKAGE.parents[1]


def data_folder(name: str) -> Path:
    packaged = _PACKAGE / "_data" / name
    if packaged.is_dir():  # in an installed wheel
        return packaged
    # in a checkout, or in an editable install of one
    return _CHECKOUT / {"skeleton": "state-repo-skeleton"}.get(name, name)


def documentation() -> Path | None:
    # the wheel of a published version contains the site; in a checkout, `make docs` builds it
    folders = (_PACKAGE / "_data" / "docs", _CHECKOUT / "build" / "site")
    return next((folder for folder in folders if (folder / "index.html").is_file()), None)


def _named_file(variable: str) -> Path | None:
    named = os.environ.get(variable)
    return Path(named).expanduser() if named else None


def forge_token_file() -> Path | None:
    return _named_file("DEMANDOPS_FORGE_TOKEN_FILE")


def alive_file() -> Path | None:  # a generator touches it as long as it works
    return _named_file("DEMANDOPS_ALIVE_FILE")


def folder_of_user(variable: str, below_home: str) -> Path:
    # https://specifications.freedesktop.org/basedir-spec ignores relative paths
    named = Path(os.environ.get(variable) or ".")
    if named.is_absolute():
        return named
    home = Path(os.environ.get("HOME") or os.path.expanduser("~"))  # noqa: PTH111 - raises no error
    if not home.is_absolute():
        raise StateRepoError(f"there is no home folder; set HOME or {variable} to a folder")
    return home / below_home


def data_home(state_repo: str) -> Path:  # for the generator's journal and clone
    with suppress(OSError):
        if Path(state_repo).exists():  # all spellings of a path give the same folder
            state_repo = str(Path(state_repo).resolve())
    named = os.environ.get("DEMANDOPS_DATA_HOME")
    root = Path(named) if named else folder_of_user("XDG_STATE_HOME", ".local/state") / "demandops"
    # a digest, because the address may contain a password
    return root / hashlib.sha256(os.fsencode(state_repo)).hexdigest()[:16]
