"""What each role achieves on a network, tried all at once.

Requests come without a message: a server that lets them in refuses them in an instant, and does
nothing. What is published or claimed is watched from behind the server, where only that arrives
which it let pass.
"""

import zlib
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field

import zenoh
from support.operations import OPERATIONS
from triquad_format.wire import keys
from triquad_format.wire.shares import lease_key, shares_key

MAP = "default"
OWN, OTHERS = "roof", "rear"  # sources of scans

FOLLOW_SCANS = "follow the scans of others"
FIND = "find servers"
PUBLISH_OWN = "publish as its own source"
PUBLISH_OTHERS = "publish as another's source"
PUBLISH_ALL = "publish as all sources"
DELETE = "delete on the key of its own source"
WILD = "ask all keys at once"
FORGE_STATUS = "publish the server's status"
FORGE_ANSWER = "answer in the server's name"
FORGE_TOKEN = "pass for a server"
FORGE_LEASE = "have a region of a shared map"

_REPLY_S = 20.0  # none comes where none is allowed: then the router says at once that it is over


@dataclass
class _Inbox:
    """What a subscriber received."""

    samples: list[tuple[str, str]] = field(default_factory=list)  # key, and whom it is from:
    # an attachment says so, which the server's own have not
    deleted_by: set[str] = field(default_factory=set)

    @property
    def senders(self) -> set[str]:
        return {sender for _, sender in self.samples}

    def take(self, sample: zenoh.Sample) -> None:
        sender = "" if sample.attachment is None else sample.attachment.to_string()
        if sample.kind == zenoh.SampleKind.DELETE:
            self.deleted_by.add(sender)
        else:
            self.samples.append((str(sample.key_expr), sender))


def status_replies(session: zenoh.Session) -> list[zenoh.Reply]:
    """The replies to a question, after which what was sent before has been dealt with, too."""
    key = keys.operation_key(MAP, keys.STATUS)
    every, apart = zenoh.QueryTarget.ALL, zenoh.ConsolidationMode.NONE
    return list(session.get(key, target=every, consolidation=apart, timeout=_REPLY_S))


def tokens(session: zenoh.Session, wanted: str = keys.alive_key("*", "*")) -> set[str]:
    found = session.liveliness().get(wanted, timeout=_REPLY_S)
    return {str(reply.ok.key_expr) for reply in found if reply.ok}


def achieved(role: str, session: zenoh.Session, observer: zenoh.Session) -> set[str]:
    """What a session with this role can do: operations, and what has a name above.

    ``observer`` may see everything.
    """
    done = _answered(session)
    done |= {FIND} if tokens(session) else set()
    with ExitStack() as parts:
        seen = parts.enter_context(_subscribed(observer, "triquad/**"))
        scans = parts.enter_context(_subscribed(session, keys.all_scans_key(MAP)))
        status_replies(session)  # the subscription is known from here on
        done |= _published(role, session, observer, seen)
        done |= _forged(role, session, observer)
        observer.put(keys.scan_key(MAP, OTHERS), b"", attachment="the observer")
        status_replies(observer)
        status_replies(session)
        done |= {FOLLOW_SCANS} if "the observer" in scans.senders else set()
    return done


def _answered(session: zenoh.Session) -> set[str]:
    """Which operations answer; all are asked before a reply is waited for."""
    waiting = {
        operation: session.get(keys.operation_key(MAP, operation), timeout=_REPLY_S)
        for operation in OPERATIONS
    }
    waiting[WILD] = session.get("triquad/**", target=zenoh.QueryTarget.ALL, timeout=_REPLY_S)
    return {operation for operation, replies in waiting.items() if list(replies)}


def _published(
    role: str, session: zenoh.Session, observer: zenoh.Session, seen: _Inbox
) -> set[str]:
    attempts = {
        PUBLISH_OWN: keys.scan_key(MAP, OWN),
        PUBLISH_OTHERS: keys.scan_key(MAP, OTHERS),
        PUBLISH_ALL: keys.all_scans_key(MAP),
        FORGE_STATUS: keys.status_key(MAP),
    }
    for key in attempts.values():
        session.put(key, b"", attachment=role)
    session.delete(keys.scan_key(MAP, OWN), attachment=role)
    status_replies(session)
    status_replies(observer)
    done = {attempt for attempt, key in attempts.items() if (key, role) in seen.samples}
    return done | ({DELETE} if role in seen.deleted_by else set())


def _forged(role: str, session: zenoh.Session, observer: zenoh.Session) -> set[str]:
    """Answers that reach somebody else, and a token that he sees."""
    key = keys.operation_key(MAP, keys.STATUS)

    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(key, role.encode())

    answering = session.declare_queryable(key, answer, complete=True)
    token = session.liveliness().declare_token(keys.alive_key(MAP, f"false-{role}"))
    forged = lease_key(MAP, 9, (0, 0, 0), zlib.crc32(role.encode()))
    lease = session.liveliness().declare_token(forged)
    list(session.get(keys.operation_key(MAP, keys.SDF), timeout=_REPLY_S))
    texts = [reply.ok.payload.to_bytes() for reply in status_replies(observer) if reply.ok]
    done = {FORGE_ANSWER} if role.encode() in texts else set()
    done |= {FORGE_TOKEN} if keys.alive_key(MAP, f"false-{role}") in tokens(observer) else set()
    done |= {FORGE_LEASE} if forged in tokens(observer, shares_key(MAP)) else set()
    answering.undeclare()
    token.undeclare()
    lease.undeclare()
    return done


@contextmanager
def _subscribed(session: zenoh.Session, key: str) -> Iterator[_Inbox]:
    inbox = _Inbox()
    at_once = zenoh.handlers.Callback(inbox.take, indirect=False)  # before what comes later
    subscriber = session.declare_subscriber(key, at_once)
    yield inbox
    subscriber.undeclare()


def expected(role: str, sources: Sequence[str]) -> set[str]:
    """What docs/security.md says of a role."""
    if role not in ("viewer", "robot", "admin"):
        return set()
    may = {FIND}
    may |= {operation for operation in OPERATIONS if operation.startswith("query/")}
    if role == "admin":
        may |= {operation for operation in OPERATIONS if operation.startswith("admin/")}
    return may | ({PUBLISH_OWN} if OWN in sources else set())
