"""Git: trees, signed commits, and the repository on this disk or behind a URL."""

import os

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
