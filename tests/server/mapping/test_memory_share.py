"""Maps of one server share its memory: none takes what another one has a right to."""

import pytest
from support import servers
from support.maps.small_world import settings
from support.poses import shifted
from triquad_server.errors import ScanRefusedError
from triquad_server.mapping.mapper import Mapper
from triquad_server.process.memory_share import MemoryShare, ServerMemory

APART_M = 60.0  # places, of which each is in a region of its own
ROOM = 1.5  # of what a place takes


def place(mapper: Mapper, number: int = 0) -> None:
    mapper.ingest(servers.sphere(8000), shifted(APART_M * number))


def counted(memory: ServerMemory) -> tuple[MemoryShare, Mapper]:
    """A map and its share, where its memory is counted."""
    share = memory.open()
    mapper = Mapper("test", settings(), "cpu", memory=share)
    share.add("map", lambda: mapper.regions.bytes_used)
    return share, mapper


@pytest.fixture
def memory() -> ServerMemory:
    """Room for a place and a half."""
    _, probe = counted(ServerMemory(10**9))
    place(probe)
    return ServerMemory(int(ROOM * probe.regions.bytes_used / 0.88))


def test_a_map_whose_share_shrinks_takes_on_what_shows_nothing_new(memory: ServerMemory) -> None:
    _, first = counted(memory)
    for _ in range(3):
        place(first)
    memory.open()
    assert first.regions.room.left < 0
    place(first)
    assert first.scans_taken == 4
    with pytest.raises(ScanRefusedError, match="each of 2 maps has"):
        place(first, 1)


def test_a_new_map_has_what_the_others_leave(memory: ServerMemory) -> None:
    large, first = counted(memory)
    place(first)
    small, second = counted(memory)
    assert large.limit == small.limit == memory.limit // 2
    with pytest.raises(ScanRefusedError, match="map_full|no more|room"):
        place(second)
    memory.close(large)
    assert small.limit == memory.limit
    place(second)
    assert small.parts() == {"program": 0, "map": second.regions.bytes_used}


def test_what_can_be_read_again_gives_way_to_regions(memory: ServerMemory) -> None:
    share, first = counted(memory)
    kept = [int(0.8 * memory.limit)]
    share.add("regions read to answer", lambda: sum(kept), kept.clear)
    place(first)
    assert first.scans_taken == 1
    assert not kept


def test_what_the_program_takes_is_shared_too() -> None:
    memory = ServerMemory(1_000_000_000)
    memory.count_program(350_000_000)
    one = memory.open()
    assert one.reserved() == memory.program == 400_000_000
    assert one.kept_bytes == 60_000_000
    other = memory.open()
    assert one.reserved() == 200_000_000
    other.add("map", lambda: 500_000_000)
    other.add("mesh tiles", lambda: 1_000_000)
    assert one.parts() == {"program": 400_000_000, "other maps": 501_000_000}
    assert one.reserved() == 200_000_000 + 201_000_000, "more than the 300 MB of its share"
    assert other.reserved() == 201_000_000
