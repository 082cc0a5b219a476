"""Another requester or a manual change in the cluster leaves releases as they were."""

from tests.e2e.common.steps import (
    test_another_requester_changes_no_object_of_a_release,
    test_plain_manifests_and_releases_are_restored,
    test_what_a_release_holds_is_restored,
)

__all__ = [
    "test_another_requester_changes_no_object_of_a_release",
    "test_plain_manifests_and_releases_are_restored",
    "test_what_a_release_holds_is_restored",
]
