"""Another requester or a manual change in the cluster leaves releases as they were."""

from tests.e2e.common.steps import (
    test_another_requester_changes_no_object_of_a_release,
    test_deleted_and_changed_objects_of_a_release_are_restored,
    test_plain_manifests_and_releases_are_restored,
)

__all__ = [
    "test_another_requester_changes_no_object_of_a_release",
    "test_deleted_and_changed_objects_of_a_release_are_restored",
    "test_plain_manifests_and_releases_are_restored",
]
