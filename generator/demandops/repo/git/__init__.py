"""Git: trees, signed commits, and the repository on this disk or behind a URL."""

import logging
import os

import pygit2
from pygit2.enums import ConfigLevel

# Anybody who may push a branch may push ``refs/replace/`` too. libgit2 reads no such reference, so
# git must not read one either: it would check another commit than the one that counts.
os.environ["GIT_NO_REPLACE_OBJECTS"] = "1"

# A hook, or a command that git runs, has these variables. They would make git work on the
# repository of the hook instead of the state repo.
for _name in (
    "GIT_ALTERNATE_OBJECT_DIRECTORIES",
    "GIT_COMMON_DIR",
    "GIT_CURL_VERBOSE",  # it would hide what a server answers from this program
    "GIT_DIR",
    "GIT_GRAFT_FILE",
    "GIT_INDEX_FILE",
    "GIT_NAMESPACE",
    "GIT_OBJECT_DIRECTORY",
    "GIT_PREFIX",
    "GIT_QUARANTINE_PATH",
    "GIT_SHALLOW_FILE",
    "GIT_WORK_TREE",
):
    os.environ.pop(_name, None)

# One wrong line in a person's settings for git stops git and libgit2 alike. They go on without.
for _read in (
    pygit2.Config.get_global_config,
    pygit2.Config.get_xdg_config,
    lambda: pygit2.Config(os.environ.get("GIT_CONFIG_GLOBAL", os.devnull)),
):
    try:
        _read()
    except OSError:
        continue  # there is no such file
    except pygit2.GitError as _error:
        for _level in (ConfigLevel.GLOBAL, ConfigLevel.XDG):
            pygit2.settings.search_path[_level] = ""
        os.environ["GIT_CONFIG_GLOBAL"] = os.devnull
        logging.getLogger("demandops").warning(
            "your settings for git are left out, also those for credentials: %s; mend that line",
            _error,
        )
        break
