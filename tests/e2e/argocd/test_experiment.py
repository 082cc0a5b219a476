"""The paper's eight steps: exactly the right services run on the right nodes."""

from tests.e2e.common.steps import test_eight_steps_and_the_fusion_is_never_restarted  # noqa: F401
