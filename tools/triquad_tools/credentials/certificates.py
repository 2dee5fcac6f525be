"""A small certificate authority, whose certificates identify servers and clients."""

import datetime
import ipaddress
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

LOCAL_HOSTS = ("localhost", "127.0.0.1", "::1")  # which every server certificate holds
_AUTHORITY_DAYS = 3650
_CLIENT = ExtendedKeyUsageOID.CLIENT_AUTH
_CLOCK_SKEW = datetime.timedelta(hours=1)  # that a robot's clock may be behind the authority's


@dataclass(frozen=True)
class Certificate:
    """A certificate and its private key on the curve P-256, both PEM."""

    pem: bytes
    key_pem: bytes

    @property
    def parsed(self) -> x509.Certificate:
        """The library's object."""
        return x509.load_pem_x509_certificate(self.pem)

    @property
    def expires(self) -> datetime.datetime:
        """The end of its validity, UTC."""
        return self.parsed.not_valid_after_utc


@dataclass(frozen=True)
class Authority:
    """Signs certificates. A program that has its private key can take any role."""

    own: Certificate

    @classmethod
    def create(cls, name: str) -> "Authority":
        """Make a new authority, valid for ten years."""
        return cls(_signed(name, _AUTHORITY_DAYS, None))

    def client(self, common_name: str, days: float) -> Certificate:
        """Issue a certificate for a client, which cannot pass for a server with it."""
        return _signed(common_name, days, self.own, x509.ExtendedKeyUsage([_CLIENT]))

    def server(self, common_name: str, hosts: Sequence[str], days: float) -> Certificate:
        """Issue a certificate to listen on ``hosts``, names or addresses, and to connect."""
        names = [_general_name(host) for host in dict.fromkeys((*LOCAL_HOSTS, *hosts))]
        usage = x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH, _CLIENT])
        return _signed(common_name, days, self.own, usage, x509.SubjectAlternativeName(names))


def _signed(
    common_name: str, days: float, issuer: Certificate | None, *extensions: x509.ExtensionType
) -> Certificate:
    """Make a key with a certificate that ``issuer`` signs, or without one the key itself."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])
    now = datetime.datetime.now(datetime.timezone.utc)
    path_length = 0 if issuer is None else None
    constraints = x509.BasicConstraints(ca=issuer is None, path_length=path_length)
    builder = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(issuer.parsed.subject if issuer else name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _CLOCK_SKEW)
        .not_valid_after(now + datetime.timedelta(days=days))
        .add_extension(constraints, critical=True)
    )
    for extension in extensions:
        builder = builder.add_extension(extension, critical=False)
    signing = key
    if issuer is not None:
        loaded = serialization.load_pem_private_key(issuer.key_pem, password=None)
        signing = cast(ec.EllipticCurvePrivateKey, loaded)
    pem, plain = serialization.Encoding.PEM, serialization.NoEncryption()
    return Certificate(
        builder.sign(signing, hashes.SHA256()).public_bytes(pem),
        key.private_bytes(pem, serialization.PrivateFormat.PKCS8, plain),
    )


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)
