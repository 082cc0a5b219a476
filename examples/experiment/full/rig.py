"""The door to the rig of the end-to-end tests, which starts the cluster, the node and Git.

Only this module of the experiment imports `tests`, and so only `make experiment` needs what those
tests need; `make demo` needs none of it.
"""
# ruff: noqa: F401 - the experiment imports from here what is imported here

from tests.e2e.common.access import access_file, documented_roles, limited, limited_world
from tests.e2e.common.expected import CLUSTER, FUSION, WITHOUT_DEMANDS
from tests.e2e.common.pod import volume_files
from tests.e2e.common.world import World, demandops, environment
from tests.e2e.rig import ENDS_WITH_US
from tests.e2e.rig.cluster import Gitops, Rig
from tests.e2e.rig.kube import Kube, Manifest
from tests.e2e.rig.net import accepts, free_port
from tests.kit.browser import chromium
from tests.kit.config import override
from tests.kit.detection import write_bag
from tests.kit.limits import PATIENCE_S
from tests.kit.repo import git
from tests.kit.rig import wait_until
from tests.kit.ros import Client, reserved
