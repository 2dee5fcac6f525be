"""The rights of each role on a network where certificates identify everybody.

Servers and routers enforce it: they allow a client what its role may do, on all maps, and the
rest is denied. Clients keep one of their own: they take nothing but from a server or a router.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from triquad_format.wire import keys
from triquad_format.wire import zenoh_access as access

LISTENING = SERVER, ROUTER = "server", "router"  # roles of those who listen, and their names
VIEWER, ROBOT, ADMIN = "viewer", "robot", "admin"
ROLES = {
    VIEWER: "may question the map and follow it",
    ROBOT: "may publish scans, as the sources named, and what a viewer may",
    ADMIN: "may reset the map and have checkpoints written, and what a viewer may; with "
    "--source, publish scans too",
}  # of clients


@dataclass(frozen=True)
class Holder:
    """The holder of a role. Names that cannot stand in a key are refused with a FormatError."""

    name: str
    role: str
    sources: tuple[str, ...] = ()  # of scans that it publishes, and nobody else
    ros2_domain: int | None = None  # of ROS 2, in which its nodes take part
    issue: str = ""  # to distinguish it from an earlier client of this name with a certificate

    def __post_init__(self) -> None:
        keys.check_name("role", self.name)
        for source in self.sources:
            keys.check_name("source", source)

    @property
    def listens(self) -> bool:
        """Whether it is the server or a router rather than a client."""
        return self.role in LISTENING

    @property
    def common_name(self) -> str:
        """The common name of its certificate, which identifies it to Zenoh."""
        return self.role if self.listens else f"{self.role}:{self.name}:{self.issue}"


def grants(granting: Holder, holders: Sequence[Holder]) -> tuple[access.Grant, ...]:
    """Return what one holder lets all of them do; who is none of these does nothing."""
    if granting.listens:
        domains = sorted({h.ros2_domain for h in holders if h.ros2_domain is not None})
        allowed = {holder.common_name: _allowed(holder, domains) for holder in holders}
    else:
        allowed = {holder.common_name: access.everything() for holder in holders if holder.listens}
    return tuple(access.Grant(name, rules, common_name=name) for name, rules in allowed.items())


def _allowed(holder: Holder, domains: Sequence[int]) -> tuple[access.Rule, ...]:
    """Return the rights of a holder, where nodes take part in these domains of ROS 2."""
    if holder.role == ROUTER:
        # Who comes through it was identified there, and beyond it may be servers, too.
        return access.everything()
    if holder.role == SERVER:
        return (*access.serve(keys.EVERY_MAP), *map(access.nodes_of_ros2, domains))
    rules = access.view(keys.EVERY_MAP)
    if holder.role == ADMIN:
        rules += access.administer(keys.EVERY_MAP)
    if holder.sources:
        rules += access.publish(keys.EVERY_MAP, holder.sources)
    if holder.ros2_domain is not None:
        rules += (access.nodes_of_ros2(holder.ros2_domain),)
    return rules
