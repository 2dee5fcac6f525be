"""Rules of access control; ``tests/attacks`` has sessions of Zenoh that try them."""

import zenoh
from triquad_format.wire import keys
from triquad_format.wire.access_control import Verb, take_part_in_ros2, without_credentials

MAP = "lab"


def test_no_rule_for_strangers_includes_an_operation_that_changes_the_map():
    (_, beyond) = without_credentials(MAP, ros2=take_part_in_ros2(MAP, 0, ["triquad/mesh"]))
    admin = zenoh.KeyExpr(keys.operation_key(MAP, keys.RESET))

    asks = [key for rule in beyond.rules if rule.verb in (Verb.ASK, Verb.ALL) for key in rule.keys]
    assert asks
    assert not [key for key in asks if zenoh.KeyExpr(key).intersects(admin)]
