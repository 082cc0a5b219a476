"""A pod's container as a process of this machine, started as a kubelet would start it.

The process has a read-only root file system of its own, the pod's volumes at their mount paths, the
pod's user, no privileges, and only the container's environment. It uses the network and the process
ids of the machine. Only root can start such a process.

Unlike in a cluster, the process cannot use shared memory. Tests restrict ROS 2 to the loopback,
and there ROS 2 would send messages through shared memory, if it could. A client outside the
container would not receive such messages.

By default the image consists of this machine's programs and this checkout. If ``E2E_IMAGE_ROOT``
names a folder, the image is the root file system in that folder (made by ``deploy/fresh-root``).
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

from tests.e2e.rig import launch
from tests.e2e.rig.kube import Kube, Manifest

from .volumes import files

ROOT = Path(__file__).parents[3]
IMAGE_VARIABLE = "E2E_IMAGE_ROOT"

# Arguments: the root's folder; the image; the folders and the Python that replace an image;
# MODE:SOURCE:TARGET for each volume; user; group; and the command.
_START = """
root=$1 image=$2 folders=$3 python=$4 volumes=$5 user=$6 group=$7
shift 7
show_folders() {
  for folder in $folders; do
    [ -z "$(ls -A "$root$folder" 2>/dev/null)" ] || continue
    mkdir -p "$root$folder"
    mount --bind "$folder" "$root$folder"
    mount -o remount,bind,ro "$root$folder"
  done
}
mount -t tmpfs -o mode=755 tmpfs "$root"
if [ -n "$image" ]; then
  mkdir "$root/above" "$root/work" "$root/merged"
  mount -t overlay -o "lowerdir=$image,upperdir=$root/above,workdir=$root/work" pod "$root/merged"
  root=$root/merged
else
  cp -a /etc /bin /sbin /lib* "$root/"
  echo "demandops:x:$user:$group::/:/bin/sh" >>"$root/etc/passwd"
  mkdir "$root/image"
  printf '#!/bin/sh\nexec %s -m demandops.cli.main "$@"\n' "$python" >"$root/image/demandops"
  chmod 755 "$root/image/demandops"
  show_folders
fi
mkdir -p "$root/proc" "$root/dev"
mount --bind /proc "$root/proc"
mount --bind /dev "$root/dev"
mount -t tmpfs -o mode=700 tmpfs "$root/dev/shm"
for volume in $volumes; do
  mode=${volume%%:*} target=${volume##*:} source=${volume#*:}
  chroot "$root" mkdir -p "$target"
  target=$(chroot "$root" realpath "$target")  # an image's link must not lead out of it
  mount --bind "${source%:*}" "$root$target"
  mount -o "remount,bind,$mode" "$root$target"
done
[ -n "$image" ] || show_folders  # a volume may hide one: this checkout may be below /tmp
mount -o remount,bind,ro "$root"
cd /
exec chroot "$root" setpriv --reuid "$user" --regid "$group" --groups "$group" \
  --bounding-set=-all --inh-caps=-all --no-new-privs --pdeathsig KILL env -i "$@"
"""


class Pod:
    """A pod's only container as a process.

    When the pod has ended, ``folder`` still has its log and the data of its volume claims.
    """

    def __init__(self, kube: Kube, name: str, namespace: str, server: str, folder: Path) -> None:
        """Read the pod from the API; ``server`` is the API server's host and port."""
        self._kube, self._namespace, self._folder = kube, namespace, folder
        found = kube.get("Pod", name, namespace)
        assert found is not None
        self.manifest: Manifest = found
        self.log = folder / f"{name}.log"
        self._start = 0
        self._host, self._port = server.rsplit(":", 1)
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def container(self) -> dict[str, Any]:
        (container,) = self.manifest["spec"]["containers"]
        return dict(container)

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    @property
    def code(self) -> int | None:
        """The exit code of the process; None while it runs."""
        assert self._process is not None
        return self._process.poll()

    def start(self) -> None:
        container, security = self.container, self.manifest["spec"]["securityContext"]
        assert container["securityContext"]["readOnlyRootFilesystem"]
        sources = {
            volume["name"]: self._volume(volume, security["fsGroup"])
            for volume in self.manifest["spec"]["volumes"]
        }
        mounts = []
        for mount in container["volumeMounts"]:
            mode = "ro" if mount.get("readOnly") else "rw"
            mounts.append(f"{mode}:{sources[mount['name']]}:{mount['mountPath']}")
        root = self._folder / f"{self.log.stem}-root"
        root.mkdir(exist_ok=True)
        image = os.environ.get(IMAGE_VARIABLE, "")
        environment = {} if image else {"PYTHONPATH": os.environ.get("PYTHONPATH", "")}
        environment |= {
            "PATH": "/image:/usr/local/bin:/usr/bin:/bin",
            "KUBERNETES_SERVICE_HOST": self._host,
            "KUBERNETES_SERVICE_PORT": self._port,
        }
        environment |= {each["name"]: each["value"] for each in container["env"]}
        folders = {"/usr", str(ROOT), os.path.realpath(sys.prefix), sys.base_prefix}
        ids = [str(security["runAsUser"]), str(security["runAsGroup"])]
        variables = [f"{name}={value}" for name, value in environment.items()]
        command = [*container["command"], *container["args"]]
        with self.log.open("ab") as log:
            self._start = log.tell()
            self._process = subprocess.Popen(
                [
                    *launch.command("/usr/bin/unshare", "--mount", "--propagation", "private"),
                    *("/bin/sh", "-eu", "-c", _START, "pod", str(root), image),
                    *(
                        " ".join(sorted(folders)),
                        sys.executable,
                        " ".join(mounts),
                        *ids,
                        *variables,
                        *command,
                    ),
                ],
                stdout=log,
                stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL,
            )

    def text(self) -> str:
        """Return what the container has printed since its last start."""
        return self.log.read_bytes()[self._start :].decode(errors="replace")

    def kill(self) -> None:
        """Kill the container, as if its cluster node had died."""
        assert self._process is not None
        self._process.kill()
        self._process.wait(10)

    def stop(self) -> int:
        """Send the container a SIGTERM, wait for its end, and return its exit code."""
        assert self._process is not None
        self._process.send_signal(signal.SIGTERM)
        return self._process.wait(self.manifest["spec"]["terminationGracePeriodSeconds"])

    def _volume(self, volume: dict[str, Any], group: int) -> Path:
        """Return a folder with the content of a volume, readable by the pod's group."""
        if "persistentVolumeClaim" in volume:
            folder = self._folder / volume["persistentVolumeClaim"]["claimName"]
        else:
            folder = self._folder / f"{self.log.stem}-{volume['name']}"
        folder.mkdir(exist_ok=True)
        folder.chmod(0o2775)
        os.chown(folder, 0, group)
        mode = 0o644
        if secret := volume.get("secret"):
            mode = secret["defaultMode"] | 0o440
        account = self.manifest["spec"]["serviceAccountName"]
        for name, content in files(self._kube, self._namespace, account, volume).items():
            file = folder / name
            file.unlink(missing_ok=True)
            file.write_bytes(content)
            file.chmod(mode)
            os.chown(file, 0, group)
        return folder
