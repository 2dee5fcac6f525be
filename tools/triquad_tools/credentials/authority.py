"""A small certificate authority: its certificates are what servers and clients know each other by.

All keys are on the curve P-256.
"""

import datetime
import ipaddress
from collections.abc import Sequence
from dataclasses import dataclass

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from triquad_tools.credentials.certificate import Certificate

LOCAL_HOSTS = ("localhost", "127.0.0.1", "::1")
"""What a server on the same machine is called; every server certificate holds."""

_AUTHORITY_DAYS = 3650
_CLOCK_SKEW = datetime.timedelta(hours=1)
"""By so much the clock of a robot may be behind that of the authority."""


@dataclass(frozen=True)
class Authority:
    """Signs certificates. Whoever has its private key can take any role."""

    own: Certificate

    @classmethod
    def create(cls, name: str) -> "Authority":
        """A new authority, valid for ten years."""
        key = ec.generate_private_key(ec.SECP256R1())
        builder = _builder(name, name, key, _AUTHORITY_DAYS)
        builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), True)
        builder = builder.add_extension(_usage(signs_certificates=True), True)
        identifier = x509.SubjectKeyIdentifier.from_public_key(key.public_key())
        builder = builder.add_extension(identifier, False)
        return cls(Certificate.of(builder.sign(key, hashes.SHA256()), key))

    def client(self, common_name: str, days: float) -> Certificate:
        """A certificate for one who connects, and who cannot pass for a server with it."""
        return self._issue(common_name, days, [ExtendedKeyUsageOID.CLIENT_AUTH], [])

    def server(self, common_name: str, hosts: Sequence[str], days: float) -> Certificate:
        """A certificate for one who listens on ``hosts``, names or addresses, and connects."""
        usages = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
        return self._issue(common_name, days, usages, [*LOCAL_HOSTS, *hosts])

    def _issue(
        self, common_name: str, days: float, usages: list[x509.ObjectIdentifier], hosts: list[str]
    ) -> Certificate:
        key = ec.generate_private_key(ec.SECP256R1())
        builder = _builder(common_name, self.own.common_name, key, days)
        builder = builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), True)
        builder = builder.add_extension(_usage(signs_certificates=False), True)
        builder = builder.add_extension(x509.ExtendedKeyUsage(usages), False)
        own = self.own.key
        issuer = x509.AuthorityKeyIdentifier.from_issuer_public_key(own.public_key())
        builder = builder.add_extension(issuer, False)
        if hosts:
            names = [_general_name(host) for host in dict.fromkeys(hosts)]
            builder = builder.add_extension(x509.SubjectAlternativeName(names), False)
        return Certificate.of(builder.sign(own, hashes.SHA256()), key)


def _builder(
    subject: str, issuer: str, key: ec.EllipticCurvePrivateKey, days: float
) -> x509.CertificateBuilder:
    now = datetime.datetime.now(datetime.timezone.utc)
    return (
        x509.CertificateBuilder()
        .subject_name(_name(subject))
        .issuer_name(_name(issuer))
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _CLOCK_SKEW)
        .not_valid_after(now + datetime.timedelta(days=days))
    )


def _name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)
