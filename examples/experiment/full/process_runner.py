"""Runs the containers of a namespace's pods as processes of this machine, as a kubelet would.

The runner watches the API server: it starts a pod that got a node, and ends a pod that is deleted.
Each container runs its own command with its own arguments and environment. If a container ends, the
runner restarts it after a pause, which becomes longer each time. ConfigMaps become files, which
change with the ConfigMap. The processes share this machine's file system, so a path below a mount
becomes a path below the volume's folder. A container that mounts the token of the pod's account
gets a kubeconfig for this account, in KUBECONFIG.
"""

from __future__ import annotations

import os
import queue
import re
import signal
import subprocess
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from kubernetes.client.api.core_v1_api import CoreV1Api
from kubernetes.client.exceptions import ApiException
from kubernetes.watch import Watch
from urllib3.exceptions import HTTPError

from .rig import ENDS_WITH_US, PATIENCE_S, Kube, Manifest, volume_files

_TICK_S = 0.1
_WATCH_S = 60
_NOT_YET = (LookupError, ApiException, HTTPError, OSError)
"""The errors for an object that does not exist yet, or an API server that cannot be reached."""
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 10.0
_TOKEN = "/var/run/secrets/kubernetes.io/serviceaccount"  # noqa: S105 - a folder


@dataclass
class Container:
    """A container: its process, the times of its starts, and when it may start again."""

    name: str
    command: list[str]
    environment: dict[str, str]
    process: subprocess.Popen[bytes] | None = None
    starts: list[float] = field(default_factory=list)
    due: float = 0.0


@dataclass
class RunningPod:
    """A pod with its containers: `bound` is when it got a node, `ended` when it ended."""

    manifest: dict[str, Any]
    folder: Path
    bound: float
    containers: list[Container] = field(default_factory=list)
    ended: float | None = None

    @property
    def service(self) -> str:
        """The name of the pod's release or connection client."""
        return str(self.manifest["metadata"]["labels"]["app.kubernetes.io/instance"])

    @property
    def node(self) -> str:
        return str(self.manifest["spec"]["nodeName"])

    def requests(self) -> tuple[float, float]:
        """Return the processor cores and the bytes of memory that the pod requests."""
        found = [c["resources"].get("requests", {}) for c in self.manifest["spec"]["containers"]]
        cores = sum(quantity(each.get("cpu", "0")) for each in found)
        return cores, sum(quantity(each.get("memory", "0")) for each in found)


def program_of(image: str) -> str:
    """Return the name of an image's stand-in program: the image's name without registry and tag."""
    return image.rpartition("/")[2].partition("@")[0].partition(":")[0]


def path_in_pod(text: str, mounts: Mapping[str, Path | str]) -> str:
    """Replace each path below a mount in ``text`` by its path on this machine; return the text."""
    if not mounts:
        return text
    longest_first = sorted(mounts, key=len, reverse=True)
    below = "|".join(map(re.escape, longest_first))
    # in one pass: a replacement may itself begin with the path of a mount, such as /tmp
    return re.sub(rf"(?<![\w./-])({below})(?=/|$)", lambda hit: str(mounts[hit[1]]), text)


_UNITS = {"m": 1e-3, "Ki": 2**10, "Mi": 2**20, "Gi": 2**30}


def quantity(text: str) -> float:
    for unit, factor in _UNITS.items():
        if text.endswith(unit):
            return float(text.removesuffix(unit)) * factor
    return float(text)


class ProcessRunner:
    """Acts as the kubelets of all nodes, for the pods of one namespace."""

    def __init__(
        self, kube: Kube, namespace: str, image: Path, folder: Path, environment: dict[str, str]
    ) -> None:
        """Start to watch pods and ConfigMaps, and to run the pods.

        ``image`` is the working directory of all containers, and first on their PATH; all get
        ``environment`` from it. ``folder`` is the folder for volumes and logs.
        """
        self._kube, self._namespace, self._image, self._folder = kube, namespace, image, folder
        path = os.pathsep.join([str(image), os.environ.get("PATH", os.defpath)])
        self._environment = environment | {"PATH": path}
        self.pods: dict[str, RunningPod] = {}  # by uid; includes pods that have ended
        self._waiting: dict[str, RunningPod] = {}
        self._ending: list[tuple[subprocess.Popen[bytes], float]] = []
        self._events: queue.Queue[tuple[str, Manifest]] = queue.Queue()
        self._closed = threading.Event()
        for watched in (
            ("Pod", "list_namespaced_pod"),
            ("ConfigMap", "list_namespaced_config_map"),
        ):
            threading.Thread(target=self._watch, args=watched, daemon=True).start()
        self._runner = threading.Thread(target=self._run, daemon=True)
        self._runner.start()

    def close(self) -> None:
        self._closed.set()
        self._runner.join(30)

    # --- watching ---------------------------------------------------------------------------

    def _watch(self, kind: str, method: str) -> None:
        """Queue all objects of a kind, then each change, until the runner is closed.

        A watch ends now and then. No event reports an object that is deleted before the next watch
        begins, so all objects are listed again.
        """
        read: Any = getattr(CoreV1Api(self._kube.api), method)
        plain = self._kube.api.sanitize_for_serialization
        while not self._closed.is_set():
            with suppress(Exception):  # the server may be away; the next round reads all again
                listed = read(self._namespace)
                self._events.put((f"{kind} LISTED", {"items": plain(listed.items)}))
                version = listed.metadata.resource_version
                for event in Watch().stream(
                    read, self._namespace, resource_version=version, timeout_seconds=_WATCH_S
                ):
                    self._events.put((f"{kind} {event['type']}", plain(event["object"])))
            self._closed.wait(_TICK_S)

    def _run(self) -> None:
        while not self._closed.is_set():
            with suppress(queue.Empty):
                while True:
                    self._take(*self._events.get(timeout=_TICK_S))
            self._prepare()
            self._start_due()
            self._kill_late()
        for pod in self.pods.values():
            self._end(pod)
        while self._ending:
            self._kill_late()
            time.sleep(_TICK_S)

    def _take(self, event: str, item: Manifest) -> None:
        kind, change = event.split()
        if change == "LISTED":
            for found in item["items"]:
                self._take(f"{kind} MODIFIED", found)
            if kind == "Pod":
                self._end_all_but({found["metadata"]["uid"] for found in item["items"]})
            return
        uid = item["metadata"]["uid"]
        if kind == "ConfigMap":
            if change == "MODIFIED":
                self._refresh(item["metadata"]["name"])
        elif change == "DELETED" or item["metadata"].get("deletionTimestamp"):
            self._waiting.pop(uid, None)
            if uid in self.pods:
                self._end(self.pods[uid])
        elif item["spec"].get("nodeName") and uid not in self.pods:
            folder = self._folder / item["metadata"]["name"]
            self._waiting.setdefault(uid, RunningPod(item, folder, time.time()))

    def _end_all_but(self, there: set[str]) -> None:
        """End the pods that no longer exist; ``there`` has the uids of those that do."""
        for uid in self._waiting.keys() - there:
            del self._waiting[uid]
        for uid in self.pods.keys() - there:
            self._end(self.pods[uid])

    def _prepare(self) -> None:
        """Prepare the waiting pods whose volumes can be filled; leave the others for later."""
        for uid, pod in list(self._waiting.items()):
            with suppress(*_NOT_YET):
                pod.containers = list(self._containers(pod))
                self.pods[uid] = self._waiting.pop(uid)

    # --- volumes ----------------------------------------------------------------------------

    def _containers(self, pod: RunningPod) -> Iterator[Container]:
        spec = pod.manifest["spec"]
        places = {volume["name"]: self._fill(pod, volume) for volume in spec["volumes"]}
        for container in spec["containers"]:
            mounts = {
                mount["mountPath"]: places[mount["name"]] for mount in container["volumeMounts"]
            }
            given_args = container.get("args", [])
            program = container.get("command", self._entry_point(container["image"], given_args))
            wanted = [*program, *given_args]
            given = {
                each["name"]: path_in_pod(each["value"], mounts)
                for each in container.get("env", ())
            }
            if _TOKEN in mounts:
                given["KUBECONFIG"] = str(self._kubeconfig(mounts[_TOKEN]))
            yield Container(
                container["name"], [path_in_pod(part, mounts) for part in wanted], given
            )

    def _entry_point(self, image: str, arguments: list[str]) -> list[str]:
        """Return the stand-in for an image's entry point; without it arguments are the command."""
        program = program_of(image)
        is_named = arguments[:1] == [program]
        return [program] if (self._image / program).exists() and not is_named else []

    def _fill(self, pod: RunningPod, volume: dict[str, Any]) -> Path:
        """Write the files of a volume, each atomically; return the volume's folder."""
        folder = pod.folder / volume["name"]
        folder.mkdir(parents=True, exist_ok=True)
        account = pod.manifest["spec"].get("serviceAccountName", "default")
        for name, content in volume_files(self._kube, self._namespace, account, volume).items():
            new = folder / f".{name}"
            new.write_bytes(content)
            new.replace(folder / name)
        return folder

    def _refresh(self, config_map: str) -> None:
        for pod in self.pods.values():
            for volume in pod.manifest["spec"]["volumes"] if pod.ended is None else ():
                if volume.get("configMap", {}).get("name") == config_map:
                    with suppress(*_NOT_YET):  # the ConfigMap may be gone
                        self._fill(pod, volume)

    def _kubeconfig(self, account: Path) -> Path:
        server = self._kube.api.configuration.host
        config: dict[str, Any] = {"apiVersion": "v1", "kind": "Config", "current-context": "c"}
        for part, content in {
            "cluster": {"server": server, "certificate-authority": str(account / "ca.crt")},
            "user": {"token": (account / "token").read_text()},
            "context": {"cluster": "c", "user": "c", "namespace": self._namespace},
        }.items():
            config[f"{part}s"] = [{"name": "c", part: content}]
        file = account.with_suffix(".kubeconfig")
        file.touch(mode=0o600)
        file.write_text(yaml.safe_dump(config))
        return file

    # --- processes --------------------------------------------------------------------------

    def _start_due(self) -> None:
        for pod in self.pods.values():
            for container in pod.containers if pod.ended is None else ():
                process = container.process
                if process is not None and process.poll() is not None:
                    container.process = None
                    pause = min(_FIRST_PAUSE_S * 2 ** len(container.starts), _LONGEST_PAUSE_S)
                    container.due = time.monotonic() + pause
                if container.process is None and time.monotonic() >= container.due:
                    self._start(pod, container)

    def _start(self, pod: RunningPod, container: Container) -> None:
        environment = self._environment | container.environment
        # `env` looks for the program on the container's PATH, as a container's runtime does
        command = [*ENDS_WITH_US, "/usr/bin/env", *container.command]
        with (pod.folder / f"{container.name}.log").open("ab") as log:
            container.process = subprocess.Popen(
                command,
                cwd=self._image,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        container.starts.append(time.time())

    def _end(self, pod: RunningPod) -> None:
        if pod.ended is not None:
            return
        pod.ended = time.time()
        grace = pod.manifest["spec"].get("terminationGracePeriodSeconds", 30)
        for container in pod.containers:
            if container.process is not None and container.process.poll() is None:
                _signal(container.process, signal.SIGTERM)
                self._ending.append((container.process, time.monotonic() + grace))

    def _kill_late(self) -> None:
        for process, deadline in list(self._ending):
            if process.poll() is None and time.monotonic() < deadline:
                continue
            _signal(process, signal.SIGKILL)  # also ends the rest of its process group
            process.wait(PATIENCE_S)
            self._ending.remove((process, deadline))


def _signal(process: subprocess.Popen[bytes], number: signal.Signals) -> None:
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, number)
