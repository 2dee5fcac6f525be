"""The rights of each role on a network where certificates identify everybody.

Servers and routers enforce it: they allow a client what its role may do, on all maps, and the
rest is denied. Clients keep one of their own: they take nothing but from a server or a router.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from triquad_format.wire import access_control as access
from triquad_format.wire import keys

SERVER = "server"
ROUTER = "router"  # common names of the certificates of those who listen


class Role(Enum):
    """The role of a client; all may do what a viewer may."""

    VIEWER = "viewer"  # questions the map, and follows it
    ROBOT = "robot"  # publishes scans as its own sources
    ADMIN = "admin"  # resets the map, has checkpoints written


@dataclass(frozen=True)
class Holder:
    """A client with a role. Names that cannot stand in a key are refused with a FormatError."""

    name: str
    role: Role
    sources: tuple[str, ...] = ()  # of scans that it publishes, and nobody else
    ros2_domain: int | None = None  # of ROS 2, in which its nodes take part
    issue: str = ""  # to distinguish it from an earlier client of this name with a certificate

    def __post_init__(self) -> None:
        keys.check_name("role", self.name)
        for source in self.sources:
            keys.check_name("source", source)

    @property
    def common_name(self) -> str:
        """The common name of its certificate, which identifies it to Zenoh."""
        return f"{self.role.value}:{self.name}:{self.issue}"


def server_grants(holders: Sequence[Holder]) -> tuple[access.Grant, ...]:
    """Return what a server or a router lets others do; all who are none of these do nothing."""
    domains = sorted({h.ros2_domain for h in holders if h.ros2_domain is not None})
    topics = tuple(_take_part(domain) for domain in domains)
    return (
        access.Grant(_known_as(SERVER), (*access.serve(keys.EVERY_MAP), *topics)),
        # Who comes through a router was identified there, and beyond it may be servers, too.
        access.Grant(_known_as(ROUTER), access.everything()),
        *(access.Grant(_known_as(holder.common_name), _allowed(holder)) for holder in holders),
    )


def client_grants() -> tuple[access.Grant, ...]:
    """Return what a client lets others do: servers and routers all, and nobody else anything."""
    return tuple(access.Grant(_known_as(name), access.everything()) for name in (SERVER, ROUTER))


def _allowed(holder: Holder) -> tuple[access.Rule, ...]:
    rules = access.view(keys.EVERY_MAP)
    if holder.role is Role.ADMIN:
        rules += access.administer(keys.EVERY_MAP)
    if holder.sources:
        rules += access.publish(keys.EVERY_MAP, holder.sources)
    if holder.ros2_domain is not None:
        rules += (_take_part(holder.ros2_domain),)
    return rules


def _take_part(domain: int) -> access.Rule:
    """Return rights to a ROS 2 domain, by rmw_zenoh: topics, their history, the graph of nodes."""
    keys_of_domain = f"{domain}/**", f"{domain}/**/@adv/**", f"@ros2_lv/{domain}/**"
    return access.Rule(access.Verb.ALL, keys_of_domain)


def _known_as(common_name: str) -> access.Subject:
    return access.Subject(common_name, cert_common_names=(common_name,))
