"""Rights as Zenoh's ``access_control``, from rules that name what is done on which keys.

All is denied but what a rule allows. Zenoh lets a message pass where the key expression of a rule
*includes* that of the message. A list of what is forbidden would not do: the selector
``triquad/**`` is not included in ``triquad/*/admin/**``, and reaches what is below it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

from triquad_format.wire import keys
from triquad_format.wire.shares import shares_key

LOOPBACK = "lo"
"""The network interface of links from programs of the same machine, on Linux."""

_EVERY_MESSAGE = (
    "put",
    "delete",
    "query",
    "reply",
    "declare_subscriber",
    "declare_queryable",
    "liveliness_token",
    "liveliness_query",
    "declare_liveliness_subscriber",
)


class Verb(Enum):
    """An action on a key: messages of Zenoh from who does it, and messages to them."""

    ASK = (("query",), ("reply", "declare_queryable"))
    ANSWER = (("reply", "declare_queryable"), ("query",))
    PUBLISH = (("put",), ("declare_subscriber",))
    RECEIVE = (("declare_subscriber",), ("put", "delete"))
    FIND = (("liveliness_query", "declare_liveliness_subscriber"), ("liveliness_token",))
    BE_FOUND = (("liveliness_token",), ("liveliness_query", "declare_liveliness_subscriber"))
    ALL = (_EVERY_MESSAGE, _EVERY_MESSAGE)


@dataclass(frozen=True)
class Rule:
    """A rule that allows something; or forbids it, whatever else allows it."""

    verb: Verb
    keys: tuple[str, ...]  # key expressions; a wildcard does not include chunks that begin with @
    forbidden: bool = False


@dataclass(frozen=True)
class Grant:
    """The rights of the other end of a link. What fits several grants may do what any of them says.

    All that is given has to match; where nothing is, it is everybody's.
    """

    name: str
    rules: tuple[Rule, ...]
    interface: str | None = None  # of this machine, over which the link comes
    common_name: str | None = None  # of the certificate shown, with mTLS

    @property
    def subject(self) -> dict[str, Any]:
        """The other end, as Zenoh writes it."""
        given = {"interfaces": self.interface, "cert_common_names": self.common_name}
        return {"id": self.name} | {kind: [one] for kind, one in given.items() if one is not None}


def access_control(grants: Sequence[Grant]) -> dict[str, Any]:
    """Return the section ``access_control`` of the configuration of a server or a router.

    The names of grants have to differ.
    """
    rules, policies = [], []
    for grant in grants:
        entries = [
            entry
            for number, rule in enumerate(grant.rules)
            for entry in _entries(f"{grant.name} {number} {rule.verb.name.lower()}", rule)
        ]
        rules += entries
        policies.append({"subjects": [grant.name], "rules": [entry["id"] for entry in entries]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [grant.subject for grant in grants],
        "policies": policies,
    }


def without_credentials(*, ros2: Sequence[Rule] = ()) -> tuple[Grant, ...]:
    """Return the rights at a map server that distinguishes people only by where they come from.

    Programs of this machine may do everything. What comes from beyond may question all maps, follow
    them and publish scans, and what ``ros2`` allows besides.
    """
    beyond = (*view(keys.EVERY_MAP), *publish(keys.EVERY_MAP), *ros2)
    here = Grant("this-machine", everything(), interface=LOOPBACK)
    return here, Grant("everybody", beyond)


def view(map_name: str) -> tuple[Rule, ...]:
    """Return the rules to query a map and to follow it."""
    return (
        Rule(Verb.ASK, (keys.all_queries_key(map_name),)),
        Rule(Verb.RECEIVE, (keys.status_key(map_name),)),
        Rule(Verb.FIND, (keys.alive_key("*", "*"), shares_key("*"))),
    )


def publish(map_name: str, sources: Sequence[str] | None = None) -> tuple[Rule, ...]:
    """Return the rules to publish the scans of these sources, or of all; nobody reads others'."""
    if sources is None:
        return (Rule(Verb.PUBLISH, (keys.all_scans_key(map_name),)),)
    return (Rule(Verb.PUBLISH, tuple(keys.scan_key(map_name, source) for source in sources)),)


def administer(map_name: str) -> tuple[Rule, ...]:
    """Return the rules to change a map but by scans, and what its server keeps on disk."""
    return (Rule(Verb.ASK, (keys.all_admin_key(map_name),)),)


def serve(map_name: str) -> tuple[Rule, ...]:
    """Return the rules to be the server of a map, behind a router."""
    return (
        Rule(Verb.ANSWER, (keys.all_queries_key(map_name), keys.all_admin_key(map_name))),
        Rule(Verb.RECEIVE, (keys.all_scans_key(map_name),)),
        Rule(Verb.PUBLISH, (keys.status_key(map_name),)),
        Rule(Verb.BE_FOUND, (keys.alive_key(map_name, "*"), shares_key(map_name))),
        Rule(Verb.FIND, (shares_key(map_name),)),
    )


def nodes_of_ros2(domain: int) -> Rule:
    """Return rights to a ROS 2 domain, by rmw_zenoh: topics, their history, the graph of nodes."""
    return Rule(Verb.ALL, (f"{domain}/**", f"{domain}/**/@adv/**", f"@ros2_lv/{domain}/**"))


def take_part_in_ros2(domain: int, published: Sequence[str] = ()) -> tuple[Rule, ...]:
    """Return the rules for nodes of rmw_zenoh in a domain, or bridges that publish any topics.

    ``published`` are the keys on which bridges receive what the server publishes. Since a topic may
    have any name, bridges may publish on all keys, but not on those of map servers.
    """
    return (
        nodes_of_ros2(domain),
        Rule(Verb.FIND, ("@/*/@ros2_lv/**",)),
        Rule(Verb.BE_FOUND, ("@/*/@ros2_lv/**",)),
        Rule(Verb.ANSWER, ("@/*/@ros2_pub_cache/**", "**/@adv/**")),
        Rule(Verb.BE_FOUND, ("**/@adv/**",)),
        Rule(Verb.PUBLISH, ("**",)),
        Rule(Verb.PUBLISH, (keys.status_key(keys.EVERY_MAP),), forbidden=True),
        *((Rule(Verb.RECEIVE, tuple(published)),) if published else ()),
    )


def everything() -> tuple[Rule, ...]:
    """Return rules for everything; Zenoh has no wildcard for chunks that begin with ``@``."""
    own = ("**/@alive/**", "**/@share/**", "**/@adv/**", "@/**")
    of_ros2 = ("@ros2_lv/**", "@/*/@ros2_lv/**", "@/*/@ros2_pub_cache/**")
    return (Rule(Verb.ALL, ("**", *own, *of_ros2)),)


def _entries(name: str, rule: Rule) -> list[dict[str, Any]]:
    """Return a rule as Zenoh writes it: an entry for each direction."""
    return [
        {
            "id": f"{name} {flow}",
            "permission": "deny" if rule.forbidden else "allow",
            "flows": [flow],
            "messages": list(messages),
            "key_exprs": list(rule.keys),
        }
        for flow, messages in zip(("ingress", "egress"), rule.verb.value, strict=True)
    ]
