"""The API server, with Argo CD's own CRDs, accepts all golden manifests in a dry run."""
# ruff: noqa: F401

from tests.e2e.common.steps import (
    test_the_dry_run_refuses_an_unknown_field,
    test_the_server_takes_every_golden_manifest,
)
