"""A certificate with its private key, as text."""

import datetime
from dataclasses import dataclass
from typing import cast

from cryptography import x509
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

PrivateKey = ec.EllipticCurvePrivateKey


@dataclass(frozen=True)
class Certificate:
    """A certificate and its private key, both PEM."""

    pem: bytes
    key_pem: bytes

    @classmethod
    def of(cls, certificate: x509.Certificate, key: PrivateKey) -> "Certificate":
        """That of the library's objects."""
        return cls(
            certificate.public_bytes(serialization.Encoding.PEM),
            key.private_bytes(
                serialization.Encoding.PEM,
                serialization.PrivateFormat.PKCS8,
                serialization.NoEncryption(),
            ),
        )

    @property
    def common_name(self) -> str:
        """Whom it is of."""
        (attribute,) = self.parsed.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
        return str(attribute.value)

    @property
    def expires(self) -> datetime.datetime:
        """Until when it is valid, UTC."""
        return self.parsed.not_valid_after_utc

    @property
    def parsed(self) -> x509.Certificate:
        """The library's object."""
        return x509.load_pem_x509_certificate(self.pem)

    @property
    def key(self) -> PrivateKey:
        """The library's object."""
        return cast(PrivateKey, serialization.load_pem_private_key(self.key_pem, password=None))
