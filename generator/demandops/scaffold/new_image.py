"""A new container file and new pipelines for the repository of a ROS package.

The pipelines test the package, build its image, and propose the image to the state repo, pinned by
its digest. Pure.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

from demandops.config.repo_settings import as_git_url
from demandops.errors import InvalidInput
from demandops.quoting import quoted

_PATHS = {
    "Containerfile": "Containerfile",
    "github-workflow.yml": ".github/workflows/image.yml",
    "gitlab-ci.yml": ".gitlab-ci.yml",
    "propose-image": "ci/propose-image",
}
# The templates put these values into YAML and shell scripts as they are, so no character of them
# may need quotes.
_NAME = re.compile(r"[a-z0-9]([-a-z0-9]{0,61}[a-z0-9])?")
_REPOSITORY = re.compile(r"(?P<host>[a-z0-9.-]+(:[0-9]+)?)(/[a-z0-9._-]+)+")
_URL = re.compile(r"(https|ssh)://([A-Za-z0-9._-]+@)?[A-Za-z0-9.-]+(:[0-9]+)?/[A-Za-z0-9._~/-]+")


def files(name: str, repository: str, state_repo: str, texts: Mapping[str, str]) -> dict[str, str]:
    """Return the container file and the pipelines, as a map from path to text.

    ``name`` is the image's name in the registry of the state repo, ``repository`` has a host, and
    ``texts`` has the files in ``templates/scaffold/image`` by name.
    """
    url, image = as_git_url(state_repo), _REPOSITORY.fullmatch(repository)
    if not _NAME.fullmatch(name):
        message = (
            f"{quoted(name)} is no valid name; use at most 63 of a-z, 0-9 and -, and no - at its "
            "ends"
        )
        raise InvalidInput.at("NAME", message)
    if image is None:
        message = (
            f"{quoted(repository)} is no valid repository; write HOST/PATH in lower case, without "
            "a tag"
        )
        raise InvalidInput.at("--repository", message)
    if not _URL.fullmatch(url):
        message = f"{quoted(state_repo)} is no valid URL; write https://HOST/PATH or git@HOST:PATH"
        raise InvalidInput.at("--state-repo", message)
    given = {"NAME": name, "REPOSITORY": repository, "HOST": image["host"], "STATE_REPO": url}
    return {
        _PATHS[file]: re.sub("@([A-Z_]+)@", lambda match: given[match[1]], text)
        for file, text in texts.items()
    }
