"""An autoscaler sets the number of replicas, and the GitOps controller does not reset it."""

from tests.e2e.common.steps import test_an_autoscaler_owns_the_number_of_replicas  # noqa: F401
