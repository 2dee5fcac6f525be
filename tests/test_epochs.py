import pytest
from triquad_format.field_settings import FieldSettings
from triquad_server.epoch import Epoch
from triquad_server.epochs import EpochShelf
from triquad_server.errors import RequestError
from triquad_server.settings import MeshSettings


def epoch(number: int) -> Epoch:
    return Epoch("lab", number, FieldSettings(), MeshSettings(), ())


def test_zero_asks_for_the_newest():
    shelf = EpochShelf(epoch(1), kept=2)
    shelf.add(epoch(2))
    assert shelf.get(0).number == shelf.newest.number == 2
    assert shelf.get(1).number == 1


def test_the_epoch_used_longest_ago_goes():
    shelf = EpochShelf(epoch(1), kept=2)
    for number in (2, 3):
        shelf.add(epoch(number))
    with pytest.raises(RequestError, match=r"epoch 1 is not kept; kept are \[2, 3\]") as caught:
        shelf.get(1)
    assert caught.value.code == "epoch_gone"


def test_an_epoch_that_is_asked_for_stays_while_newer_ones_come():
    shelf = EpochShelf(epoch(1), kept=3)
    for number in range(2, 20):
        shelf.add(epoch(number))
        assert shelf.get(1).number == 1
        assert shelf.get(0).number == number


def test_the_newest_never_goes():
    shelf = EpochShelf(epoch(1), kept=1)
    shelf.add(epoch(2))
    assert shelf.get(0).number == shelf.get(2).number == 2
