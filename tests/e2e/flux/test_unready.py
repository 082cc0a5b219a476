"""A service that cannot start does not delay demands."""

from tests.e2e.common.steps import test_a_service_that_cannot_start_is_reconfigured_and_removed  # noqa: F401
