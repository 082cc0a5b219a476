"""The components of a control plane without containers: etcd, API server, controllers, scheduler.

This module returns `Component`s and starts nothing. Everything listens on loopback. etcd does not
flush its files to the disk, because tests need no data after a power cut. Each part runs once, so
there is no leader election.
"""

from __future__ import annotations

from pathlib import Path

from .net import LOOPBACK, answers, free_port, url
from .pki import Pki
from .processes import Component

_SERVICES = "10.96.0.0/16"


class ControlPlane:
    def __init__(self, binaries: dict[str, Path], folder: Path, pki: Pki) -> None:
        self.binaries, self.folder, self.pki = binaries, folder, pki
        self.etcd_port, self.api_port = free_port(), free_port()

    @property
    def server(self) -> str:
        return url(self.api_port, "https")

    def etcd(self) -> Component:
        """Return etcd, which keeps its data when it restarts."""
        client, peer = url(self.etcd_port), url(free_port())
        argv = [
            str(self.binaries["etcd"]),
            "--name=rig",
            f"--data-dir={self.folder / 'etcd'}",
            f"--listen-client-urls={client}",
            f"--advertise-client-urls={client}",
            f"--listen-peer-urls={peer}",
            f"--initial-advertise-peer-urls={peer}",
            f"--initial-cluster=rig={peer}",
            "--unsafe-no-fsync",
            "--log-level=warn",
        ]
        return Component("etcd", tuple(argv), answers(self.etcd_port, "/readyz"))

    def apiserver(self) -> Component:
        """Return the API server; it counts as ready once its post-start hooks have run."""
        pki = self.pki
        argv = [
            str(self.binaries["kube-apiserver"]),
            f"--etcd-servers={url(self.etcd_port)}",
            f"--bind-address={LOOPBACK}",
            f"--advertise-address={LOOPBACK}",
            f"--secure-port={self.api_port}",
            f"--cert-dir={self.folder / 'apiserver'}",
            f"--tls-cert-file={pki.server_certificate}",
            f"--tls-private-key-file={pki.server_key}",
            f"--client-ca-file={pki.authority}",
            "--service-account-issuer=https://kubernetes.default.svc",
            f"--service-account-key-file={pki.account_public}",
            f"--service-account-signing-key-file={pki.account_private}",
            f"--service-cluster-ip-range={_SERVICES}",
            "--authorization-mode=RBAC",
            "--allow-privileged=true",
            "--kubelet-preferred-address-types=InternalIP",  # `kubectl exec` needs it
            # The API server refuses endpoints on loopback, so it must not publish its own.
            "--endpoint-reconciler-type=none",
        ]
        probe = answers(self.api_port, "/readyz", pki.authority)
        return Component("kube-apiserver", tuple(argv), probe)

    def controller_manager(self, kubeconfig: Path) -> Component:
        """Return the controllers that turn a Deployment into pods and delete orphaned objects."""
        port = free_port()
        argv = [
            str(self.binaries["kube-controller-manager"]),
            f"--kubeconfig={kubeconfig}",
            f"--service-account-private-key-file={self.pki.account_private}",
            f"--root-ca-file={self.pki.authority}",
            # With the defaults of 20 and 30 this client would slow down a burst of releases.
            "--kube-api-qps=200",
            "--kube-api-burst=400",
            # On a slow machine, a node must not count as lost.
            "--node-monitor-grace-period=10m",
            *self._serving(port),
        ]
        probe = answers(port, "/healthz", self.pki.authority)
        return Component("kube-controller-manager", tuple(argv), probe)

    def scheduler(self, kubeconfig: Path) -> Component:
        port = free_port()
        program = str(self.binaries["kube-scheduler"])
        argv = [program, f"--kubeconfig={kubeconfig}", *self._serving(port)]
        probe = answers(port, "/healthz", self.pki.authority)
        return Component("kube-scheduler", tuple(argv), probe)

    def _serving(self, port: int) -> list[str]:
        return [
            "--leader-elect=false",
            f"--bind-address={LOOPBACK}",
            f"--secure-port={port}",
            f"--tls-cert-file={self.pki.server_certificate}",
            f"--tls-private-key-file={self.pki.server_key}",
        ]
