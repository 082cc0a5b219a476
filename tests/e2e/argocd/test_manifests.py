"""The API server, with Argo CD's own CRDs, accepts all golden manifests in a dry run."""

from tests.e2e.common.steps import (  # noqa: F401
    test_the_server_takes_every_golden_manifest_and_no_unknown_field,
)
