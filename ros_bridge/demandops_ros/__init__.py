"""The ROS 2 bridge, and the client for Python programs.

    from demandops_ros import DemandClient

The client's names are imported only when they are used, because rclpy is slow to import and the
command line does not need it.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from demandops_ros.client import Answer, DemandClient, DemandError, HeldDemand, StageListener

__all__ = ["Answer", "DemandClient", "DemandError", "HeldDemand", "StageListener"]


def __getattr__(name: str) -> Any:  # noqa: ANN401 - mypy reads the imports above
    if name not in __all__:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(import_module("demandops_ros.client"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
