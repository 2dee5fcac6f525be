"""Rules of access control, enforced by real sessions of Zenoh."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import zenoh
from support.attackers.beyond import from_beyond
from support.servers import free_endpoint, raw_session
from triquad_format.wire import keys
from triquad_format.wire.access_control import (
    Grant,
    Verb,
    access_control,
    take_part_in_ros2,
    without_credentials,
)

MAP = "lab"
OPERATIONS = [keys.operation_key(MAP, name) for name in (keys.SDF, keys.STATUS, keys.RESET)]
SECRET = [OPERATIONS[2]]
OPEN = OPERATIONS[:2]


def test_no_rule_for_strangers_includes_an_operation_that_changes_the_map():
    (_, beyond) = without_credentials(MAP, ros2=take_part_in_ros2(MAP, 0, ["triquad/mesh"]))
    admin = zenoh.KeyExpr(keys.operation_key(MAP, keys.RESET))

    asks = [key for rule in beyond.rules if rule.verb in (Verb.ASK, Verb.ALL) for key in rule.keys]
    assert asks
    assert not [key for key in asks if zenoh.KeyExpr(key).intersects(admin)]


@contextmanager
def router(grants: tuple[Grant, ...]) -> Iterator[tuple[zenoh.Session, str]]:
    """A router with these grants that answers all operations, and its endpoint on all addresses."""
    endpoint = free_endpoint().replace("127.0.0.1", "0.0.0.0")
    with (
        raw_session("router", listen=endpoint, access_control=access_control(grants)) as session,
        ExitStack() as declared,
    ):
        for key in OPERATIONS:

            def reply(query: zenoh.Query, key: str = key) -> None:
                query.reply(key, b"done")
                query.drop()

            handler = zenoh.handlers.Callback(reply, indirect=False)
            queryable = session.declare_queryable(key, handler, complete=True)
            declared.callback(queryable.undeclare)
        token = session.liveliness().declare_token(keys.alive_key(MAP, "s"))
        declared.callback(token.undeclare)
        yield session, endpoint


def answering(session: zenoh.Session, selector: str) -> list[str]:
    replies = session.get(
        selector,
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
        timeout=2.0,
    )
    return sorted(str(reply.ok.key_expr) for reply in replies if reply.ok)


def put(session: zenoh.Session, key: str) -> None:
    session.put(key, b"", congestion_control=zenoh.CongestionControl.BLOCK)


def test_a_bridge_of_ros_publishes_on_any_key_but_not_as_the_server():
    rules = take_part_in_ros2(MAP, 0, ["triquad/mesh"])
    with ExitStack() as stack:
        session, endpoint = stack.enter_context(router(without_credentials(MAP, ros2=rules)))
        received = stack.enter_context(session.declare_subscriber("**"))
        bridge = stack.enter_context(raw_session(connect=from_beyond(endpoint)))
        for key in ("triquad/lab/status", "roof/points", "0/points/t/h", "last"):
            put(bridge, key)
        keys_received = [str(received.recv().key_expr) for _ in range(3)]
        assert keys_received == ["roof/points", "0/points/t/h", "last"]
        assert answering(bridge, SECRET[0]) == []

        mesh = bridge.declare_subscriber("triquad/mesh")
        scans = bridge.declare_subscriber("triquad/lab/scan/*")
        answering(bridge, OPEN[0])
        put(session, "triquad/lab/scan/a")
        put(session, "triquad/mesh")
        assert str(mesh.recv().key_expr) == "triquad/mesh"
        assert scans.try_recv() is None
