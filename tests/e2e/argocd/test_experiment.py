"""The paper's eight steps with Argo CD: exactly the right services run on the right nodes."""

from tests.e2e.common.steps import test_eight_steps_and_the_fusion_is_never_restarted

__all__ = ["test_eight_steps_and_the_fusion_is_never_restarted"]
