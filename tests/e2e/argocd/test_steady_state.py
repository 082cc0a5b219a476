"""Another requester changes no release, and the controller undoes manual changes in the cluster."""
# ruff: noqa: F401

from tests.e2e.common.steps import (
    test_another_requester_changes_no_object_of_a_release,
    test_deleted_and_changed_objects_of_a_release_are_restored,
    test_plain_manifests_and_releases_are_restored,
)
