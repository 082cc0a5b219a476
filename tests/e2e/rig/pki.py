"""Certificates and keys of a rig's control plane, made by openssl for each rig.

One authority signs the certificates of the servers and of the administrator. The keys are
elliptic-curve keys, because these are made fast.
"""

from __future__ import annotations

import base64
import json
import subprocess
from pathlib import Path

_CURVE = ("-pkeyopt", "ec_paramgen_curve:P-256")
_EXTENSIONS = Path(__file__).with_name("openssl.cnf")


class Pki:
    """The files of certificates and keys; `account_*` signs the tokens of service accounts."""

    def __init__(self, folder: Path) -> None:
        self.authority = folder / "ca.crt"
        self.server_certificate, self.server_key = folder / "server.crt", folder / "server.key"
        self.admin_certificate, self.admin_key = folder / "admin.crt", folder / "admin.key"
        self.account_private, self.account_public = folder / "accounts.key", folder / "accounts.pub"


def make(folder: Path) -> Pki:
    """Create the certificates and keys of a control plane, and write them into a folder."""
    folder.mkdir(parents=True)
    paths, signer = Pki(folder), folder / "ca.key"

    def certify(subject: str, certificate: Path, key: Path, *signed_by: Path) -> None:
        options = ["-config", _EXTENSIONS, "-days", "30", "-subj", subject]
        if signed_by:
            options += ["-extensions", "signed", "-CA", signed_by[0], "-CAkey", signed_by[1]]
        else:
            options += ["-extensions", "authority"]
        output = ("-noenc", "-keyout", key, "-out", certificate)
        _openssl("req", "-x509", "-newkey", "ec", *_CURVE, *options, *output)

    by = (paths.authority, signer)
    certify("/CN=rig-authority", *by)
    certify("/CN=rig-server", paths.server_certificate, paths.server_key, *by)
    # Each cluster makes the group system:masters administrators from the start.
    admin = "/O=system:masters/CN=rig-admin"
    certify(admin, paths.admin_certificate, paths.admin_key, *by)
    _openssl("genpkey", "-algorithm", "EC", *_CURVE, "-out", paths.account_private)
    _openssl("pkey", "-in", paths.account_private, "-pubout", "-out", paths.account_public)
    return paths


def write_kubeconfig(target: Path, name: str, server: str, pki: Pki) -> None:
    """Write an administrator's kubeconfig with all certificates, as JSON, which is YAML."""

    def inline(path: Path) -> str:
        return base64.b64encode(path.read_bytes()).decode()

    cluster = {"server": server, "certificate-authority-data": inline(pki.authority)}
    user = {
        "client-certificate-data": inline(pki.admin_certificate),
        "client-key-data": inline(pki.admin_key),
    }
    content = {
        "apiVersion": "v1",
        "kind": "Config",
        "current-context": name,
        "clusters": [{"name": name, "cluster": cluster}],
        "users": [{"name": name, "user": user}],
        "contexts": [{"name": name, "context": {"cluster": name, "user": name}}],
    }
    target.touch(mode=0o600)
    target.write_text(json.dumps(content, indent=2))


def _openssl(*arguments: str | Path) -> None:
    subprocess.run(["openssl", *map(str, arguments)], check=True, capture_output=True)
