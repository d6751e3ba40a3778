"""Certificates for this machine by a small authority of its own, which a phone has to trust once.

Browsers open cameras only over HTTPS, and no public authority certifies an address at home. The authority's
key never leaves its folder; who has it could pretend to be any site to phones that trust it.
"""

import os
import socket
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from slimsfm.errors import InputError

_AUTHORITY_DAYS, _DAYS = 3650, 397  # phones refuse certificates of servers that are valid for longer
_EARLIER = timedelta(days=1)  # clocks of phones may be behind


@dataclass(frozen=True, kw_only=True)
class Certificate:
    """Files of a server's certificate."""

    chain: Path
    """The certificate, PEM."""

    key: Path
    """Its private key, PEM."""

    authority: Path | None = None
    """The authority's certificate, for phones to trust; None for a certificate of the user's own."""


def default_folder() -> Path:
    """Where the authority is kept: in the user's data folder."""
    base = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return Path(base) / "slimsfm" / "authority"


def certificate_for(hosts: tuple[str, ...], folder: Path | None = None) -> Certificate:
    """Make a certificate for the addresses of this machine, by the authority that is kept in a folder.

    Args:
        hosts: Names and addresses that clients connect to; this machine's name is added.
        folder: Where the authority is; made if there is none.

    Raises:
        InputError: The folder cannot be used or holds something else.
    """
    folder = folder or default_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        authority, key = _authority(folder)
        own_key = ec.generate_private_key(ec.SECP256R1())
        made = _signed(own_key, _alternative_names(hosts), authority, key)
        found = Certificate(
            chain=folder / "server.pem", key=folder / "server.key", authority=folder / "authority.pem"
        )
        _write(found.key, _key_bytes(own_key))
        _write(found.chain, made.public_bytes(Encoding.PEM) + authority.public_bytes(Encoding.PEM))
    except (OSError, ValueError, TypeError) as error:
        raise InputError(
            f"{folder}: no usable authority ({error}); remove the folder to make another"
        ) from error
    return found


def _authority(folder: Path) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
    """The authority in a folder, created if there is none or it expires soon."""
    path, key_path = folder / "authority.pem", folder / "authority.key"
    if path.exists() and key_path.exists():
        known = x509.load_pem_x509_certificate(path.read_bytes())
        key = load_pem_private_key(key_path.read_bytes(), None)
        if not isinstance(key, ec.EllipticCurvePrivateKey):
            raise ValueError("its key is of another kind")
        if known.not_valid_after_utc > datetime.now(UTC) + timedelta(days=_DAYS):
            return known, key
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"slimsfm on {socket.gethostname()}"[:64])])
    made = (
        _begun(name, name, key, _AUTHORITY_DAYS)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(signs=True), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .sign(key, SHA256())
    )
    _write(key_path, _key_bytes(key))
    _write(path, made.public_bytes(Encoding.PEM))
    return made, key


def _signed(
    own_key: ec.EllipticCurvePrivateKey,
    names: x509.SubjectAlternativeName,
    authority: x509.Certificate,
    key: ec.EllipticCurvePrivateKey,
) -> x509.Certificate:
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "slimsfm serve")])
    by = x509.AuthorityKeyIdentifier.from_issuer_public_key(key.public_key())
    return (
        _begun(subject, authority.subject, own_key, _DAYS)
        .add_extension(names, critical=False)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(signs=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False)
        .add_extension(by, critical=False)
        .sign(key, SHA256())
    )


def _begun(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePrivateKey, days: int
) -> x509.CertificateBuilder:
    now = datetime.now(UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _EARLIER)
        .not_valid_after(now - _EARLIER + timedelta(days=days))
    )


def _usage(*, signs: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs,
        key_cert_sign=signs,
        crl_sign=signs,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _alternative_names(hosts: tuple[str, ...]) -> x509.SubjectAlternativeName:
    own = socket.gethostname()
    names = dict.fromkeys([*hosts, "localhost", own, f"{own}.local", "127.0.0.1"])
    return x509.SubjectAlternativeName([_alternative_name(one) for one in names])


def _alternative_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _key_bytes(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())


def _write(path: Path, data: bytes) -> None:
    """Write a file that only this user may read."""
    partial = path.with_name(f"{path.name}.{os.getpid()}")
    with os.fdopen(os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "wb") as file:
        file.write(data)
    partial.replace(path)
