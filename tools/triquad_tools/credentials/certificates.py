"""Certificates that identify servers and clients, and the authority that signs them."""

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
_CLIENT = ExtendedKeyUsageOID.CLIENT_AUTH  # a certificate for this alone cannot pass for a server
_CLOCK_SKEW = datetime.timedelta(hours=1)  # that a robot's clock may be behind the authority's


@dataclass(frozen=True)
class Certificate:
    """A certificate and its private key on the curve P-256, both PEM."""

    pem: str
    key_pem: str

    @property
    def parsed(self) -> x509.Certificate:
        """The library's object."""
        return x509.load_pem_x509_certificate(self.pem.encode())

    def issue(
        self, common_name: str, days: float, hosts: Sequence[str] | None = None
    ) -> "Certificate":
        """Sign a certificate for a client, or for a server on ``hosts``, names or addresses."""
        if hosts is None:
            return _signed(self, common_name, days, x509.ExtendedKeyUsage([_CLIENT]))
        usage = x509.ExtendedKeyUsage([_CLIENT, ExtendedKeyUsageOID.SERVER_AUTH])
        names = x509.SubjectAlternativeName([_general_name(h) for h in (*LOCAL_HOSTS, *hosts)])
        return _signed(self, common_name, days, usage, names)


def new_authority(name: str) -> Certificate:
    """Make a certificate that signs others for ten years: with its key one can take any role."""
    return _signed(None, name, _AUTHORITY_DAYS)


def _signed(
    issuer: Certificate | None, common_name: str, days: float, *extensions: x509.ExtensionType
) -> Certificate:
    """Make a key with a certificate that ``issuer`` signs, or without one the key itself."""
    key = signing = ec.generate_private_key(ec.SECP256R1())
    name = signer = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])
    if issuer:
        loaded = serialization.load_pem_private_key(issuer.key_pem.encode(), password=None)
        signing, signer = cast(ec.EllipticCurvePrivateKey, loaded), issuer.parsed.subject
    now = datetime.datetime.now(datetime.timezone.utc)
    start, end = now - _CLOCK_SKEW, now + datetime.timedelta(days=days)
    serial = x509.random_serial_number()
    builder = x509.CertificateBuilder(signer, name, key.public_key(), serial, start, end)
    constraints = x509.BasicConstraints(ca=not issuer, path_length=None if issuer else 0)
    builder = builder.add_extension(constraints, critical=True)
    for extension in extensions:
        builder = builder.add_extension(extension, critical=False)
    pem, plain = serialization.Encoding.PEM, serialization.NoEncryption()
    signed = builder.sign(signing, hashes.SHA256()).public_bytes(pem)
    private = key.private_bytes(pem, serialization.PrivateFormat.PKCS8, plain)
    return Certificate(signed.decode(), private.decode())


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)
