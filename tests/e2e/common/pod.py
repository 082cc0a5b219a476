"""A pod's container as a process of this machine, started as a kubelet would start it.

The process has a read-only root file system of its own, the pod's volumes at their mount paths, the
pod's user, no privileges, and only the container's environment. It uses the network and the process
ids of the machine. Only root can start such a process.

Unlike in a cluster, the process cannot use shared memory. Tests restrict ROS 2 to the loopback,
and there ROS 2 would send messages through shared memory, if it could. A client outside the
container would not receive such messages.

By default the image consists of this machine's programs and this checkout. If ``E2E_IMAGE_ROOT``
names a folder, the image is the root file system in that folder (``root`` of ``deploy/image``).
"""

from __future__ import annotations

import base64
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from tests.e2e.rig import ENDS_WITH_US
from tests.e2e.rig.kube import Kube, Manifest

ROOT = Path(__file__).parents[3]
IMAGE_VARIABLE = "E2E_IMAGE_ROOT"

_START = Path(__file__).with_name("start-pod.sh")


class Pod:
    """A pod's only container as a process; ``folder`` has its log and volume claims."""

    def __init__(self, kube: Kube, name: str, namespace: str, server: str, folder: Path) -> None:
        """Read the pod from the API; ``server`` is the API server's host and port."""
        self._kube, self._namespace, self._folder = kube, namespace, folder
        self._server = server
        found = kube.wait(f"pod {name}", lambda: kube.get("Pod", name, namespace))
        self.manifest: Manifest = found
        self.log = folder / f"{name}.log"
        self._process: Any = None

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def code(self) -> int | None:
        return self._process.poll()

    def start(self) -> None:
        spec = self.manifest["spec"]
        security, (container,) = spec["securityContext"], spec["containers"]
        assert container["securityContext"]["readOnlyRootFilesystem"]
        sources = {
            volume["name"]: self._volume(volume, security["fsGroup"]) for volume in spec["volumes"]
        }
        mounts = []
        for mount in container["volumeMounts"]:
            mode = "ro" if mount.get("readOnly") else "rw"
            mounts.append(f"{mode}:{sources[mount['name']]}:{mount['mountPath']}")
        root = self._folder / f"{self.log.stem}-root"
        root.mkdir(exist_ok=True)
        image = os.environ.get(IMAGE_VARIABLE, "")
        host, port = self._server.rsplit(":", 1)
        environment = {
            "PYTHONPATH": "" if image else os.environ.get("PYTHONPATH", ""),
            "PATH": "/image:/usr/local/bin:/usr/bin:/bin",
            "KUBERNETES_SERVICE_HOST": host,
            "KUBERNETES_SERVICE_PORT": port,
            **{each["name"]: each["value"] for each in container["env"]},
        }
        folders = {"/usr", str(ROOT), os.path.realpath(sys.prefix), sys.base_prefix}
        ids = [str(security["runAsUser"]), str(security["runAsGroup"])]
        variables = [f"{name}={value}" for name, value in environment.items()]
        command = [*container["command"], *container["args"]]
        with self.log.open("wb") as log:
            self._process = subprocess.Popen(
                [
                    *(*ENDS_WITH_US, "/usr/bin/unshare", "--mount", "--propagation", "private"),
                    *("/bin/sh", "-eu", str(_START), str(root), image, " ".join(sorted(folders))),
                    *(sys.executable, " ".join(mounts), *ids, *variables, *command),
                ],
                stdout=log,
                stderr=log,
                stdin=subprocess.DEVNULL,
            )

    def text(self) -> str:
        """Return what the container has printed since its last start."""
        return self.log.read_text(errors="replace")

    def wait_text(self, *texts: str) -> None:
        def told() -> bool:
            assert self.code is None, self.text()
            return any(text in self.text() for text in texts)

        self._kube.wait(f"{' or '.join(texts)} in {self.log}", told)

    def kill(self) -> None:
        self._process.kill()
        self._process.wait(10)

    def _volume(self, volume: dict[str, Any], group: int) -> Path:
        """Return a folder with the content of a volume, readable by the pod's group."""
        claim = volume.get("persistentVolumeClaim", {}).get("claimName")
        folder = self._folder / (claim or f"{self.log.stem}-{volume['name']}")
        folder.mkdir(exist_ok=True)
        folder.chmod(0o2775)
        os.chown(folder, 0, group)
        secret = volume.get("secret")
        account = self.manifest["spec"]["serviceAccountName"]
        for name, content in volume_files(self._kube, self._namespace, account, volume).items():
            file = folder / name
            file.unlink(missing_ok=True)
            file.write_bytes(content)
            file.chmod(secret["defaultMode"] | 0o440 if secret else 0o644)
            os.chown(file, 0, group)
        return folder


def volume_files(
    kube: Kube, namespace: str, account: str, volume: dict[str, Any]
) -> dict[str, bytes]:
    """Return the content of a volume's files by name; raise LookupError if it is missing."""
    if secret := volume.get("secret"):
        data = _data(kube, "Secret", namespace, secret["secretName"])
        return {key: base64.b64decode(value) for key, value in data.items()}
    if config := volume.get("configMap"):
        return _texts(_data(kube, "ConfigMap", namespace, config["name"]))
    found: dict[str, bytes] = {}
    for source in volume.get("projected", {}).get("sources", ()):
        if wanted := source.get("serviceAccountToken"):
            found[wanted["path"]] = kube.token(account, namespace).encode()
        elif config := source.get("configMap"):
            data = _data(kube, "ConfigMap", namespace, config["name"])
            found |= _texts({item["path"]: data[item["key"]] for item in config["items"]})
        else:
            (item,) = source["downwardAPI"]["items"]
            assert item["fieldRef"]["fieldPath"] == "metadata.namespace"
            found[item["path"]] = namespace.encode()
    known = {"name", "emptyDir", "persistentVolumeClaim", "projected"}
    assert volume.keys() <= known, volume
    return found


def _texts(data: dict[str, str]) -> dict[str, bytes]:
    return {key: value.encode() for key, value in data.items()}


def _data(kube: Kube, kind: str, namespace: str, name: str) -> dict[str, str]:
    found = kube.get(kind, name, namespace)
    if found is None:
        raise LookupError(f"{kind} {namespace}/{name} does not exist")
    return dict(found.get("data") or {})
