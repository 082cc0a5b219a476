"""With Argo CD the answer to a demand reports whether its services run."""

from tests.e2e.common.answers import *  # noqa: F403
