"""Takes and gives regions of a map that several servers share.

Three rules decide who has a region, and everybody finds the same by them. One that nobody has is
taken by the server that is chosen for it among those that are there. Who has one for which another
is chosen by now writes it to its store and gives it away, once no scan has reached it for a while.
Of several who have the same, as after the network was divided, the one of the lowest number keeps
it; the others write it to their stores and give it away, and the first learns from their scans.
"""

import logging
import threading
import time
from collections.abc import Mapping

from triquad_format.errors import FormatError
from triquad_format.records.field_settings import RegionIndex
from triquad_format.scan_log.log_folder import LOG_NAME, segments
from triquad_format.scan_log.segment import LoggedScan, read_segment

from triquad_server.epochs.cold_region import ColdRegion
from triquad_server.errors import (
    MapperStoppedError,
    NoRoomYetError,
    ScanRefusedError,
    StoreError,
)
from triquad_server.mapping.mapper import Mapper
from triquad_server.mapping.mapper_thread import MapperThread
from triquad_server.sharing.contests import EndedContest
from triquad_server.sharing.leases import Leases
from triquad_server.sharing.stores import Stores, version_of
from triquad_server.store.checkpoint_writer import CheckpointWriter

_log = logging.getLogger(__name__)

_TURN_S = 0.5  # after which it is looked again what others have
_SEEN_S = 1.0  # until others have seen a checkpoint: so long what it lists is not given away
_TOLD = 8  # problems that the status tells
_RESTS_S = 10.0  # for which no scan has reached a region that is given away


class Sharing:
    """Has a server take and give regions of a shared map, in a thread of its own."""

    def __init__(
        self,
        leases: Leases,
        stores: Stores,
        mapper: MapperThread,
        checkpoints: CheckpointWriter,
    ) -> None:
        """Begin; clients find this server once it has tried to take its regions."""
        self._leases = leases
        self._stores = stores
        self._mapper = mapper
        self._checkpoints = checkpoints
        self._elsewhere: dict[RegionIndex, ColdRegion] | None = None  # as it was told last
        self._was_leaving: frozenset[RegionIndex] = frozenset()
        self._listed_s: dict[RegionIndex, float] = {}  # monotonic: since when others find them
        self._reached_s: dict[RegionIndex, float] = {}  # monotonic: when a scan last did
        self._problem = ""  # why regions are not taken or given
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="sharing")
        self._thread.start()

    def close(self) -> None:
        """Leave all regions to the others, as they are now."""
        self._stopping.set()
        self._leases.changed.set()
        self._thread.join()
        self._mapper.pause()  # what came after the checkpoint would be lost
        try:
            self._checkpoints.write()
        except (StoreError, MapperStoppedError) as error:
            _log.error("the others go on from an older checkpoint of this server: %s", error)
        if self._leases.others:
            time.sleep(_SEEN_S)
        self._leases.close()

    def warnings(self) -> list[str]:
        """Return what keeps this server from sharing the map as it should."""
        stores = self._leases.stores
        told = [*filter(None, [self._problem, stores.problem]), *stores.unreadable.values()]
        more = [f"{len(told) - _TOLD} more regions cannot be taken"] if len(told) > _TOLD else []
        return [*told[:_TOLD], *more, *self._leases.clock_problems()]

    def _run(self) -> None:
        self._leases.appear()
        self._try()
        self._leases.be_ready()
        while not self._stopping.is_set():
            self._leases.changed.wait(_TURN_S)
            self._leases.changed.clear()
            self._try()

    def _try(self) -> None:
        problem = ""
        try:
            self._turn()
        except MapperStoppedError:
            _log.debug("no regions are taken or given any more: mapping has ended")
        except (StoreError, OSError) as error:
            problem = f"regions are not taken or given: {error}"
            if problem != self._problem:
                _log.error("%s", problem)
        except Exception:
            problem = "regions are not taken or given: an internal error; the log has the details"
            _log.exception("regions are not taken or given")
        self._problem = problem

    def _turn(self) -> None:
        self._see()
        self._give()
        for contest in self._leases.contests.take_ended(self._leases.holders):
            self._learn_from(contest)
        self._stores.set_aside_empty(self._leases)

    def _see(self) -> None:
        """Take what this server is to have, and see what it is not to have any more."""
        awaited = self._leases.take_awaited()
        reached = self._mapper.ask(lambda mapper: mapper.regions.room.take_reached())
        self._reached_s.update(dict.fromkeys(reached | awaited, time.monotonic()))
        self._take(awaited)
        self._see_what_has_to_go()

    def _take(self, awaited: set[RegionIndex]) -> None:
        """Take what nobody has and this server is chosen for, and see what others have.

        First those for which scans wait.
        """
        self._leases.stores.look()
        self._stores.refresh()
        newest = self._stores.newest(self._leases)
        # Where one cannot be read, nothing is begun or taken: it may have more.
        self._leases.stores.problem = "; ".join(self._stores.problems.values())
        if not self._stores.problems:
            self._leases.stores.have(newest.keys())
            self._take_free(newest, awaited)
        held = self._leases.held
        elsewhere = {index: region for index, region in newest.items() if index not in held}
        if elsewhere != self._elsewhere:
            self._elsewhere = elsewhere
            self._mapper.call(lambda mapper: mapper.regions.all.others_have(elsewhere))

    def _take_free(
        self, newest: Mapping[RegionIndex, ColdRegion], awaited: set[RegionIndex]
    ) -> None:
        unreadable = self._leases.stores.unreadable
        for index in list(unreadable):
            if index not in newest or self._leases.holders(index):
                unreadable.pop(index, None)  # its folder was moved away, or another could read it
        for index in sorted(newest, key=lambda index: index not in awaited):
            if self._leases.is_free(index):
                try:
                    self._take_region(newest[index])
                except StoreError as error:
                    if unreadable.get(index) != str(error):
                        _log.error("%s", error)
                    unreadable[index] = str(error)

    def _take_region(self, region: ColdRegion) -> None:
        # No checkpoint may be written in between: it would be without the region.
        with self._checkpoints.writing:
            own = self._stores.own(region)
            self._mapper.call(lambda mapper: mapper.regions.all.adopt(own))
        # Last, since scans change it from then on, and questions come: an epoch shows it by now.
        self._leases.take(region.index)
        _log.info("region %s is taken, as of epoch %d", region.index, version_of(own))

    def _see_what_has_to_go(self) -> None:
        """See which regions of this server go to others."""
        for index in self._leases.held:
            lowest = next(iter(self._leases.holders(index)))
            rests = time.monotonic() - self._reached_s.get(index, 0.0) > _RESTS_S
            is_contested = lowest != self._leases.number
            if self._leases.has_to_go(index) and (rests or is_contested):
                self._leases.leaving.add(index)
            else:
                self._leases.leaving.discard(index)

    def _give(self) -> None:
        """Give away what leaves, once the store has it."""
        leaving = frozenset(self._leases.leaving)
        if leaving or self._was_leaving:
            self._mapper.ask(lambda mapper: mapper.regions.room.give(leaving))
        self._was_leaving = leaving
        stored = leaving
        if leaving:
            stored -= self._mapper.ask(lambda mapper: leaving & mapper.regions.all.in_memory)
        self._listed_s = {i: at_s for i, at_s in self._listed_s.items() if i in stored}
        if new := stored - self._listed_s.keys():
            self._checkpoints.write()  # by its list others find them
            self._listed_s.update(dict.fromkeys(new, time.monotonic()))
        for index, at_s in self._listed_s.items():
            if time.monotonic() - at_s > _SEEN_S:
                self._give_region(index)

    def _give_region(self, index: RegionIndex) -> None:
        given = self._mapper.call(lambda mapper: mapper.regions.all.give(index))
        if given is None:  # a reset came in between
            if self._mapper.ask(lambda mapper: index in mapper.regions.all.in_memory):
                return  # it has read what stays of it
            self._checkpoints.write()  # without it
        if self._leases.release(index):
            _log.info("region %s is given away", index)
        elif given is not None:
            self._mapper.call(lambda mapper: mapper.regions.all.adopt(given))

    def _learn_from(self, contest: EndedContest) -> None:
        """Take in what another server has kept of the scans while it had regions, too."""
        wanted = contest.regions & self._leases.held
        if not wanted:
            return  # it is the other one that keeps them
        learnt = 0
        for segment in segments(self._stores.folder(contest.number) / LOG_NAME):
            if segment.epoch < contest.since_ms:
                continue
            try:
                for entry in read_segment(segment.path):
                    if self._leases.changed.is_set():  # a scan may wait for a region
                        self._leases.changed.clear()
                        self._see()
                    if isinstance(entry, LoggedScan):
                        learnt += self._learn(entry, wanted)
            except (FormatError, OSError) as error:
                _log.error("scans of server %d cannot be read: %s", contest.number, error)
        _log.warning(
            "server %d had %d regions of this one, too: %d scans that it kept are taken in",
            *(contest.number, len(wanted), learnt),
        )

    def _learn(self, scan: LoggedScan, wanted: frozenset[RegionIndex]) -> bool:
        """Take in a scan where it reaches regions; return whether it does."""

        def take(mapper: Mapper) -> bool | None:
            before, regions = mapper.scans_taken, mapper.regions
            may_have, regions.may_have = regions.may_have, wanted.__contains__
            try:
                mapper.ingest(
                    scan.points,
                    scan.world_from_sensor,
                    scan.stamp_ns // 1_000_000_000,
                    source=scan.source,
                    no_return=scan.no_return,
                    local=True,
                )
            except NoRoomYetError:
                return None
            finally:
                regions.may_have = may_have
            return mapper.scans_taken > before

        while not self._stopping.is_set():
            try:
                if (learnt := self._mapper.ask(take)) is not None:
                    return learnt
                self._stopping.wait(_TURN_S)
            except ScanRefusedError as error:
                _log.debug("a scan of another server is not used: %s", error)
                return False
        return False
