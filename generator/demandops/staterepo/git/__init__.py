"""Git: trees, signed commits, and the repository on this disk or behind a URL."""

import os

# Anybody who may push a branch may push ``refs/replace/`` too. libgit2 reads no such reference, so
# git must not read one either: it would check another commit than the one that counts.
os.environ["GIT_NO_REPLACE_OBJECTS"] = "1"
