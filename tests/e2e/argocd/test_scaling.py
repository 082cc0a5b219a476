"""An autoscaler sets the number of replicas, and Argo CD does not reset it."""

from tests.e2e.common.steps import test_an_autoscaler_owns_the_number_of_replicas

__all__ = ["test_an_autoscaler_owns_the_number_of_replicas"]
