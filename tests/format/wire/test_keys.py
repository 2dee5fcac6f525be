import pytest
from support.operations import OPERATIONS
from triquad_format.errors import FormatError
from triquad_format.wire import keys
from triquad_format.wire.messages import Scan


def test_keys_are_those_of_the_specification():
    assert keys.operation_key("lab", keys.SDF) == "triquad/lab/query/sdf"
    assert keys.operation_key("lab", keys.RESET) == "triquad/lab/admin/reset"
    assert keys.scan_key("lab", "front.lidar") == "triquad/lab/scan/front.lidar"
    assert keys.all_scans_key("lab") == "triquad/lab/scan/*"
    assert keys.status_key("lab") == "triquad/lab/status"
    assert keys.alive_key("*", "*") == "triquad/*/@alive/*"
    assert keys.encoding(Scan) == "application/msgpack;triquad.Scan.v1"


def test_each_operation_has_a_key_of_its_own():
    assert len(set(OPERATIONS)) == len(OPERATIONS) == 23


@pytest.mark.parametrize("name", ["", "a/b", "*", "**", "a b", "$x", "@x", "_x", "é", "a" * 65])
def test_names_that_would_change_a_key_are_refused(name):
    with pytest.raises(FormatError, match="name"):
        keys.scan_key("lab", name)
    with pytest.raises(FormatError, match="name"):
        keys.operation_key(name, keys.SDF)


@pytest.mark.parametrize("name", ["a", "0", "Front_lidar-2.top", "a" * 64])
def test_plain_names_are_allowed(name):
    assert keys.check_name("source", name) == name
