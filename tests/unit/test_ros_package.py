"""The public names of ``demandops_ros``, and the imports that it makes only on use."""

from __future__ import annotations

import subprocess
import sys

import demandops_ros
import pytest

from tests.kit.limits import PATIENCE_S

IMPORT = """
import sys
import demandops_ros
assert "rclpy" not in sys.modules, "the import alone loads rclpy"
from demandops_ros import DemandClient
assert DemandClient.__module__ == "demandops_ros.client"
assert "rclpy" in sys.modules
"""


def test_only_using_the_client_imports_rclpy() -> None:
    subprocess.run([sys.executable, "-c", IMPORT], check=True, timeout=PATIENCE_S)


def test_every_public_name_can_be_imported_and_no_other() -> None:
    assert set(demandops_ros.__all__) <= set(dir(demandops_ros))
    assert all(hasattr(demandops_ros, name) for name in demandops_ros.__all__)
    with pytest.raises(AttributeError, match="module 'demandops_ros' has no attribute 'Client'"):
        demandops_ros.Client  # noqa: B018
