"""The state repo leaves this cluster's Argo CD, which was not prepared: all services run on."""

from tests.e2e.common.steps import test_a_controller_that_was_not_retired_fails_and_changes_no_pod

__all__ = ["test_a_controller_that_was_not_retired_fails_and_changes_no_pod"]
