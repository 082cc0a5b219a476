"""The state repo moves to Argo CD while the cluster still runs Flux: all services keep running."""

from tests.e2e.common.steps import test_a_controller_that_was_not_retired_fails_and_changes_no_pod

__all__ = ["test_a_controller_that_was_not_retired_fails_and_changes_no_pod"]
