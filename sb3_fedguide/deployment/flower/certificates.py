"""The certificate authority of a federation, its server's certificate, and the keys by which clients are known."""

from __future__ import annotations

import datetime
import ipaddress
import os
from collections.abc import Sequence
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

CA, CA_KEY = "ca.crt", "ca.key"
SERVER, SERVER_KEY = "server.crt", "server.key"

#: Where Flower's SuperLink listens, so that the server's certificate has to hold for it too.
LOOPBACK = "127.0.0.1"

#: How long an authority holds: several server certificates, since clients get another ``ca.crt`` by hand only.
_AUTHORITY_DAYS = 3650


def write_certificates(folder: Path, hosts: Sequence[str], days: int = 825) -> None:
    """Write ``server.crt`` and ``server.key``, signed by the authority in ``folder``; a missing authority is created.

    Of the four files, clients get only ``ca.crt``. ``ca.key`` is needed again for the next server certificate.

    :param hosts: names and addresses under which clients reach the server
    :param days: how long the server's certificate holds
    :raises ValueError: for an invalid name, where the files cannot be written, or if the authority expires earlier
    """
    names = [_general_name(host) for host in dict.fromkeys([*hosts, "localhost", LOOPBACK])]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not (folder / CA).exists() and not (folder / CA_KEY).exists():
            key = ec.generate_private_key(ec.SECP384R1())
            subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "federation's certificate authority")])
            authority = _sign(subject, subject, key, key, _AUTHORITY_DAYS, [
                (x509.BasicConstraints(ca=True, path_length=0), True), (_key_usage(signs_certificates=True), True),
            ])  # fmt: skip
            _write_private(folder / CA_KEY, _pem(key))
            (folder / CA).write_bytes(authority.public_bytes(serialization.Encoding.PEM))
        authority = x509.load_pem_x509_certificate((folder / CA).read_bytes())
        authority_key = serialization.load_pem_private_key((folder / CA_KEY).read_bytes(), password=None)
    except OSError as error:
        raise ValueError(f"{error.filename}: {error.strerror}") from None
    if not isinstance(authority_key, ec.EllipticCurvePrivateKey) or authority_key.public_key() != authority.public_key():
        raise ValueError(f"{folder / CA_KEY} is not the key of {folder / CA}; remove both to begin with a new authority")
    ends = authority.not_valid_after_utc
    if days > (left := (ends - datetime.datetime.now(datetime.UTC)).days):
        raise ValueError(
            f"{folder / CA} expires on {ends:%Y-%m-%d}, before a server certificate of {days} days; "
            f"{f'give at most {left} days, or ' if left > 0 else ''}remove {CA} and {CA_KEY} to begin with a new authority, "
            f"and replace {CA} on every client"
        )
    key = ec.generate_private_key(ec.SECP384R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, str(hosts[0])[:64])])
    extensions: list[tuple[x509.ExtensionType, bool]] = [
        (x509.BasicConstraints(ca=False, path_length=None), True),
        (_key_usage(signs_certificates=False), True),
        (x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), False),
        (x509.SubjectAlternativeName(names), False),
        (x509.AuthorityKeyIdentifier.from_issuer_public_key(authority_key.public_key()), False),
    ]
    certificate = _sign(subject, authority.subject, key, authority_key, days, extensions)
    _write_private(folder / SERVER_KEY, _pem(key))
    (folder / SERVER).write_bytes(certificate.public_bytes(serialization.Encoding.PEM))


def write_key(folder: Path, name: str) -> tuple[Path, Path]:
    """Write a client's key pair, ``name`` and ``name.pub``, in OpenSSH's format on the curve P-384, as Flower wants them.

    :return: private and public file
    :raises ValueError: if there is one already, or the files cannot be written
    """
    private, public = folder / name, folder / f"{name}.pub"
    if private.exists() or public.exists():
        raise ValueError(f"{private} exists already; a lost key cannot be made again, so remove it yourself")
    key = ec.generate_private_key(ec.SECP384R1())
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _write_private(private, key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.OpenSSH, serialization.NoEncryption()))  # fmt: skip
        public.write_bytes(
            key.public_key().public_bytes(serialization.Encoding.OpenSSH, serialization.PublicFormat.OpenSSH)
            + f" {name}\n".encode()
        )
    except OSError as error:
        raise ValueError(f"{error.filename}: {error.strerror}") from None
    return private, public


def read_public_key(text: str) -> bytes:
    """The bytes by which Flower knows a client, from a line such as ``ecdsa-sha2-nistp384 AAAA... name``.

    :raises ValueError: for anything else
    """
    from flwr.supercore.primitives.asymmetric import public_key_to_bytes

    try:
        key = serialization.load_ssh_public_key(text.encode())
    except Exception:  # whatever the parser makes of foreign bytes
        key = None
    if not isinstance(key, ec.EllipticCurvePublicKey):
        raise ValueError(f"{text[:20]!r}... is no public key of the kind that 'fedguide deploy key' writes")
    return public_key_to_bytes(key)


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        pass
    if not host or len(host) > 253 or not all(part.replace("-", "").isalnum() and part.isascii() for part in host.split(".")):
        raise ValueError(f"{host!r} is neither a host's name nor its address; give it without port, e.g. fed.example.org")
    return x509.DNSName(host)


def _key_usage(signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates, content_commitment=False, key_encipherment=False, data_encipherment=False,
        key_agreement=False, key_cert_sign=signs_certificates, crl_sign=signs_certificates, encipher_only=False,
        decipher_only=False,
    )  # fmt: skip


def _sign(
    subject: x509.Name,
    issuer: x509.Name,
    key: ec.EllipticCurvePrivateKey,
    issuer_key: ec.EllipticCurvePrivateKey,
    days: int,
    extensions: Sequence[tuple[x509.ExtensionType, bool]],
) -> x509.Certificate:
    now = datetime.datetime.now(datetime.UTC)
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(hours=1))  # clocks differ
        .not_valid_after(now + datetime.timedelta(days=days))
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )
    for extension, critical in extensions:
        builder = builder.add_extension(extension, critical)
    return builder.sign(issuer_key, hashes.SHA384())


def _pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )  # fmt: skip


def _write_private(path: Path, content: bytes) -> None:
    """Write what only its owner may read, whatever the umask."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    with os.fdopen(descriptor, "wb") as file:
        os.fchmod(descriptor, 0o600)
        file.write(content)
