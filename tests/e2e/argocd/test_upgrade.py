"""The state repo moves to the other controller before the cluster does: all keeps running."""

from tests.e2e.common.steps import test_a_controller_that_was_not_retired_fails_and_changes_no_pod  # noqa: F401
