"""Rules of access control, enforced by real sessions of Zenoh."""

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import pytest
import zenoh
from support.beyond import from_beyond
from support.servers import WAIT_S, free_endpoint, raw_session
from triquad_format.wire import keys
from triquad_format.wire.access_control import (
    EVERYBODY,
    THIS_MACHINE,
    Grant,
    Subject,
    Verb,
    access_control,
    administer,
    publish,
    serve,
    take_part_in_ros2,
    view,
    without_credentials,
)

MAP = "lab"
OPERATIONS = [keys.operation_key(MAP, name) for name in (keys.SDF, keys.STATUS, keys.RESET)]
SECRET = [OPERATIONS[2]]
OPEN = OPERATIONS[:2]


def test_a_rule_becomes_an_entry_for_each_direction():
    robot = Subject("robot", cert_common_names=("r1",), usernames=("u",), interfaces=("eth0",))
    section = access_control([Grant(robot, publish(MAP, ["roof"]))])

    assert section == {
        "enabled": True,
        "default_permission": "deny",
        "rules": [
            {
                "id": f"robot 0 publish {flow}",
                "permission": "allow",
                "flows": [flow],
                "messages": [message],
                "key_exprs": ["triquad/lab/scan/roof"],
            }
            for flow, message in (("ingress", "put"), ("egress", "declare_subscriber"))
        ],
        "subjects": [
            {
                "id": "robot",
                "interfaces": ["eth0"],
                "cert_common_names": ["r1"],
                "usernames": ["u"],
            }
        ],
        "policies": [
            {
                "subjects": ["robot"],
                "rules": ["robot 0 publish ingress", "robot 0 publish egress"],
            }
        ],
    }


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


@pytest.fixture(scope="module")
def guarded() -> Iterator[tuple[zenoh.Session, str]]:
    with router(without_credentials(MAP)) as running:
        yield running


def here(endpoint: str) -> str:
    return endpoint.replace("0.0.0.0", "127.0.0.1")


def answering(session: zenoh.Session, selector: str) -> list[str]:
    replies = session.get(
        selector,
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
        timeout=2.0,
    )
    return sorted(str(reply.ok.key_expr) for reply in replies if reply.ok)


@pytest.mark.parametrize(
    ("selector", "answers"),
    [
        *((key, [key]) for key in OPEN),
        *((key, []) for key in SECRET),
        ("triquad/lab/query/*", sorted(OPEN)),
        ("triquad/lab/admin/*", []),
        ("triquad/lab/*/reset", []),
        ("triquad/lab/**", []),
        ("triquad/**", []),
        ("**", []),
    ],
)
def test_what_strangers_ask_for_is_answered_only_below_query(guarded, selector, answers):
    with raw_session(connect=from_beyond(guarded[1])) as stranger:
        assert answering(stranger, selector) == answers


def test_programs_of_this_machine_ask_for_everything(guarded):
    with raw_session(connect=here(guarded[1])) as program:
        assert answering(program, SECRET[0]) == SECRET
        assert alive(program) == 1


def put(session: zenoh.Session, key: str) -> None:
    session.put(key, b"", congestion_control=zenoh.CongestionControl.BLOCK)


def alive(session: zenoh.Session) -> int:
    return len(list(session.liveliness().get(keys.alive_key("*", "*"), timeout=2.0)))


def test_strangers_publish_scans_alone_and_find_the_map(guarded):
    session, endpoint = guarded
    with (
        session.declare_subscriber("triquad/**") as received,
        raw_session(connect=from_beyond(endpoint)) as stranger,
    ):
        assert alive(stranger) == 1
        for key in ("triquad/lab/status", "triquad/lab/x", "triquad/**", "triquad/lab/scan/a"):
            put(stranger, key)
        assert str(received.recv().key_expr) == "triquad/lab/scan/a"


def test_strangers_neither_see_questions_and_scans_nor_answer(guarded):
    session, endpoint = guarded
    with raw_session(connect=from_beyond(endpoint)) as stranger:
        queryable = stranger.declare_queryable(OPEN[0], complete=True)
        subscriber = stranger.declare_subscriber("triquad/lab/scan/*")
        token = stranger.liveliness().declare_token(keys.alive_key(MAP, "forged"))
        answering(stranger, OPEN[1])  # the declarations have arrived

        with raw_session(connect=here(endpoint)) as program:
            for _ in range(20):
                assert answering(program, OPEN[0]) == [OPEN[0]]
            assert alive(program) == 1
            put(program, "triquad/lab/scan/a")
            answering(program, OPEN[1])
        answering(stranger, OPEN[1])
        assert queryable.try_recv() is None
        assert subscriber.try_recv() is None
        token.undeclare()


def test_a_role_grants_what_strangers_may_not():
    grants = (Grant(EVERYBODY, view(MAP)), Grant(THIS_MACHINE, administer(MAP)))
    with router(grants) as (_, endpoint), raw_session(connect=here(endpoint)) as admin:
        assert answering(admin, SECRET[0]) == SECRET


def test_a_server_behind_a_router_serves_with_the_rules_for_it():
    section = access_control([Grant(EVERYBODY, serve(MAP) + view(MAP) + publish(MAP))])
    endpoint = free_endpoint()
    with (
        raw_session("router", listen=endpoint, access_control=section),
        raw_session(connect=endpoint) as server,
        raw_session(connect=endpoint) as client,
    ):
        token = server.liveliness().declare_token(keys.alive_key(MAP, "s"))
        scans = server.declare_subscriber(keys.all_scans_key(MAP))
        queryable = server.declare_queryable(
            OPEN[0],
            zenoh.handlers.Callback(lambda query: query.reply(OPEN[0], b"x"), indirect=False),
        )
        asked_until = time.monotonic() + WAIT_S
        while answering(client, OPEN[0]) != [OPEN[0]]:  # until it is declared
            assert time.monotonic() < asked_until
        assert alive(client) == 1
        client.put(
            keys.scan_key(MAP, "roof"), b"s", congestion_control=zenoh.CongestionControl.BLOCK
        )
        assert str(scans.recv().key_expr) == keys.scan_key(MAP, "roof")
        queryable.undeclare()
        token.undeclare()


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
