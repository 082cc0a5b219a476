"""Certificates and keys of a rig's control plane, created for each rig.

One authority signs the certificates of the servers and of the administrator. The keys are
elliptic-curve keys, because these are created fast. Only the owner of the files can read the
private keys.
"""

from __future__ import annotations

import base64
import datetime
import ipaddress
import json
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

_LIFE = datetime.timedelta(days=30)
_AUTHORITY = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "rig-authority")])


class Pki:
    """The files of certificates and keys; `account_*` signs the tokens of service accounts."""

    def __init__(self, folder: Path) -> None:
        self.authority = folder / "ca.crt"
        self.server_certificate, self.server_key = folder / "server.crt", folder / "server.key"
        self.admin_certificate, self.admin_key = folder / "admin.crt", folder / "admin.key"
        self.account_private, self.account_public = folder / "accounts.key", folder / "accounts.pub"


def make(folder: Path) -> Pki:
    """Create the certificates and keys of a control plane, and write them into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    paths, authority = Pki(folder), ec.generate_private_key(ec.SECP256R1())
    root = _builder(_AUTHORITY, authority.public_key(), authority)
    _write(paths.authority, _signed(root, authority))
    server, admin, accounts = (ec.generate_private_key(ec.SECP256R1()) for _ in range(3))
    addresses = x509.SubjectAlternativeName(
        [x509.DNSName("localhost"), x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]
    )
    request = _builder(_name("rig-server"), server.public_key(), authority)
    request = request.add_extension(addresses, critical=False)
    _write(paths.server_certificate, _signed(request, authority))
    # Each cluster makes the group system:masters administrators from the start.
    request = _builder(_name("rig-admin", "system:masters"), admin.public_key(), authority)
    _write(paths.admin_certificate, _signed(request, authority))
    keys = {paths.server_key: server, paths.admin_key: admin, paths.account_private: accounts}
    for path, key in keys.items():
        encoding, form = serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8
        _write(path, key.private_bytes(encoding, form, serialization.NoEncryption()))
    public = serialization.PublicFormat.SubjectPublicKeyInfo
    _write(
        paths.account_public, accounts.public_key().public_bytes(serialization.Encoding.PEM, public)
    )
    return paths


def write_kubeconfig(target: Path, name: str, server: str, pki: Pki) -> Path:
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
    return _write(target, json.dumps(content, indent=2).encode())


def _builder(
    subject: x509.Name, key: ec.EllipticCurvePublicKey, authority: ec.EllipticCurvePrivateKey
) -> x509.CertificateBuilder:
    now = datetime.datetime.now(datetime.timezone.utc)
    ca = subject == _AUTHORITY
    signer = authority.public_key()
    unused = ("content_commitment", "data_encipherment", "key_agreement")
    never = dict.fromkeys((*unused, "key_encipherment", "encipher_only", "decipher_only"), False)
    usage = x509.KeyUsage(digital_signature=True, key_cert_sign=ca, crl_sign=ca, **never)
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(_AUTHORITY)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(minutes=5))  # a clock may be set back
        .not_valid_after(now + _LIFE)
        .add_extension(x509.BasicConstraints(ca=ca, path_length=None), critical=True)
        .add_extension(usage, critical=True)
        # Python 3.13 and later refuse a server whose certificate lacks these two extensions.
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(signer), critical=False)
    )
    if ca:
        return builder
    usages = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
    return builder.add_extension(x509.ExtendedKeyUsage(usages), critical=False)


def _signed(request: x509.CertificateBuilder, authority: ec.EllipticCurvePrivateKey) -> bytes:
    return request.sign(authority, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)


def _name(common: str, organisation: str | None = None) -> x509.Name:
    attributes = [x509.NameAttribute(NameOID.COMMON_NAME, common)]
    if organisation:
        attributes.append(x509.NameAttribute(NameOID.ORGANIZATION_NAME, organisation))
    return x509.Name(attributes)


def _write(path: Path, content: bytes) -> Path:
    path.touch(mode=0o600)
    path.write_bytes(content)
    return path
