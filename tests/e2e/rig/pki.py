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
from dataclasses import dataclass
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

_LIFE = datetime.timedelta(days=30)
_AUTHORITY = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "rig-authority")])


@dataclass(frozen=True)
class Pki:
    authority: Path
    server_certificate: Path
    server_key: Path
    admin_certificate: Path
    admin_key: Path
    account_private: Path
    account_public: Path


def make(folder: Path) -> Pki:
    """Create the certificates and keys of a control plane, and write them into a folder.

    The keys include those that sign the tokens of service accounts.
    """
    folder.mkdir(parents=True, exist_ok=True)
    authority = ec.generate_private_key(ec.SECP256R1())
    root = _builder(_AUTHORITY, authority.public_key(), authority).sign(authority, hashes.SHA256())
    paths = Pki(
        authority=_write(folder / "ca.crt", _pem(root)),
        server_certificate=folder / "server.crt",
        server_key=folder / "server.key",
        admin_certificate=folder / "admin.crt",
        admin_key=folder / "admin.key",
        account_private=folder / "accounts.key",
        account_public=folder / "accounts.pub",
    )
    server = ec.generate_private_key(ec.SECP256R1())
    addresses = x509.SubjectAlternativeName(
        [x509.DNSName("localhost"), x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]
    )
    request = _builder(_name("rig-server"), server.public_key(), authority)
    request = request.add_extension(addresses, critical=False)
    _write(paths.server_certificate, _pem(request.sign(authority, hashes.SHA256())))
    _write(paths.server_key, _private(server))
    # Each cluster makes the group system:masters administrators from the start.
    admin = ec.generate_private_key(ec.SECP256R1())
    request = _builder(_name("rig-admin", "system:masters"), admin.public_key(), authority)
    _write(paths.admin_certificate, _pem(request.sign(authority, hashes.SHA256())))
    _write(paths.admin_key, _private(admin))
    accounts = ec.generate_private_key(ec.SECP256R1())
    _write(paths.account_private, _private(accounts))
    _write(
        paths.account_public,
        accounts.public_key().public_bytes(
            serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo
        ),
    )
    return paths


def write_kubeconfig(target: Path, name: str, server: str, pki: Pki) -> Path:
    """Write an administrator's kubeconfig that contains all certificates; return its path.

    The file is JSON, which is valid YAML.
    """

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
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(_AUTHORITY)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(minutes=5))  # a clock may be set back
        .not_valid_after(now + _LIFE)
        .add_extension(x509.BasicConstraints(ca=ca, path_length=None), critical=True)
        .add_extension(_usage(ca=ca), critical=True)
        # Python 3.13 and later refuse a server whose certificate lacks these two extensions.
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(signer), critical=False)
    )
    if ca:
        return builder
    usages = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
    return builder.add_extension(x509.ExtendedKeyUsage(usages), critical=False)


def _usage(*, ca: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=True,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=ca,
        crl_sign=ca,
        encipher_only=False,
        decipher_only=False,
    )


def _name(common: str, organisation: str | None = None) -> x509.Name:
    attributes = [x509.NameAttribute(NameOID.COMMON_NAME, common)]
    if organisation:
        attributes.append(x509.NameAttribute(NameOID.ORGANIZATION_NAME, organisation))
    return x509.Name(attributes)


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _private(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )


def _write(path: Path, content: bytes) -> Path:
    path.touch(mode=0o600)
    path.write_bytes(content)
    return path
