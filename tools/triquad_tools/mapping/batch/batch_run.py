"""Making a map of a recording by many workers, region by region."""

import hashlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from operator import mul
from pathlib import Path
from typing import Any

import triquad_format
from distributed import Client, Future, KilledWorker, as_completed
from triquad_format.mapfile.reader import read_map
from triquad_format.records.field_settings import RegionIndex
from triquad_format.records.region import MapProgress, MapRecord

from triquad_tools.console.command import ToolError
from triquad_tools.console.progress import progress
from triquad_tools.mapfiles.crop import without_training
from triquad_tools.mapping.batch.cut_scans import CutScan
from triquad_tools.mapping.batch.job import Cut, Place, Refusal, cut, mapped
from triquad_tools.mapping.mapping_run import MAP_NAME, OUTSIDE, SECTIONS, another_frame
from triquad_tools.recordings.opening import Selection

_READERS = 2  # tasks that read the recording, for each worker


class BatchRun:
    """Has workers map the regions of a recording.

    Its scans are cut into files in a folder, and each region is a file there once it is done. Its
    name tells what it is made of: the same command goes on with the others.
    """

    def __init__(self, client: Client, selection: Selection, place: Place, folder: Path) -> None:
        """Let workers map a recording, with files in a ``folder`` that they all have."""
        self._client = client
        self._selection = selection
        self._place = place
        self._folder = folder
        self.refused: dict[int, Refusal] = {}  # scans that cannot be used, by their numbers

    @property
    def refusals(self) -> Counter[str]:
        """How many scans cannot be used, by reason."""
        return Counter(one.reason for one in self.refused.values())

    def record(self, *, training: bool = False) -> MapRecord:
        """Return the map, once all regions have settled.

        Args:
            training: it has the state that further training needs: then it takes four times as
                much memory.

        Raises:
            ToolError: a worker cannot do it, or the poses go on in another frame.
        """
        made, scans = self._cut()
        of_region = {
            index: {number: scan for number, scan in scans.items() if scan.box.has(index)}
            for index in made
        }
        files = {index: self._file(index, own) for index, own in of_region.items()}
        left = [index for index, file in files.items() if not file.exists()]
        futures = [
            self._client.submit(
                mapped,
                self._place,
                index,
                [(number, scan.file) for number, scan in of_region[index].items()],
                files[index],
                key=f"{self._folder}-{files[index].stem}",
                priority=len(of_region[index]),  # at the end no worker waits for long
            )
            for index in left
        ]
        with progress("mapping", len(files)) as report:
            for done, _ in enumerate(_results(futures), start=len(files) - len(left) + 1):
                report(done, f"{done} of {len(files)} regions")
        whole = (read_map(file) for file in files.values())
        return self._joined([one if training else without_training(one) for one in whole])

    def _cut(self) -> tuple[list[RegionIndex], dict[int, CutScan]]:
        """Return the regions that scans make, and where each scan is."""
        total, found = len(self._selection), list[Cut]()
        readers = _READERS * len(self._client.scheduler_info()["workers"])
        parts = [numbers for numbers in _parts(total, readers) if numbers]
        futures = [
            self._client.submit(
                cut,
                self._selection,
                self._place,
                numbers,
                self._folder,
                key=f"{self._folder}-scans-{numbers}",
            )
            for numbers in parts
        ]
        with progress("reading", total) as report:
            for one in _results(futures):
                found.append(one)
                done = sum(len(each.scans) + len(each.refused) for each in found)
                report(done, f"{done} of {total} scans")
        refused = {number: why for one in found for number, why in one.refused.items()}
        self.refused = dict(sorted(refused.items()))
        self._check_frame()
        scans = {number: scan for one in found for number, scan in one.scans.items()}
        made = frozenset[RegionIndex]().union(*(one.made for one in found))
        return sorted(made), dict(sorted(scans.items()))

    def _check_frame(self) -> None:
        """Raise :class:`ToolError` where two scans in a row are out of the world."""
        outside = [number for number, one in self.refused.items() if one.reason == OUTSIDE]
        for number in outside:
            if number + 1 in outside:
                entries, text = self._selection.entries, self.refused[number + 1].text
                raise another_frame(text, entries[number + 1], entries[0])

    def _file(self, index: RegionIndex, scans: Mapping[int, CutScan]) -> Path:
        """Return where the map of a region is written that is made of these scans."""
        place = self._place
        of_place = place.settings.model_dump_json(include=SECTIONS), place.origin_m
        digest = hashlib.sha256(f"{triquad_format.__version__} {of_place}".encode())
        for scan in scans.values():
            digest.update(scan.digest)
        return self._folder / "region{}_{}_{}-{}.triquad".format(*index, digest.hexdigest()[:16])

    def _joined(self, records: Sequence[MapRecord]) -> MapRecord:
        """Return the map that the regions make together."""
        samples = [record.progress.samples_trained for record in records]
        losses = [record.progress.loss for record in records]
        return MapRecord(
            MAP_NAME,
            epoch=1,
            settings=self._place.settings.field,
            regions=tuple(region for record in records for region in record.regions),
            progress=MapProgress(
                scans_taken=len(self._selection) - len(self.refused),
                samples_trained=sum(samples),
                loss=sum(map(mul, samples, losses)) / max(1, sum(samples)),
            ),
            origin_m=self._place.origin_m,
        )


def _parts(total: int, count: int) -> list[range]:
    """Return ``range(total)`` in parts of about the same size."""
    return [range(total * part // count, total * (part + 1) // count) for part in range(count)]


def _results(futures: Iterable["Future[Any]"]) -> Iterator[Any]:
    """Yield what tasks return, as they are done.

    Raises:
        ToolError: one ends each worker that tries it, as where memory is too short, or the
            scheduler is gone.
    """
    try:
        for future in as_completed(list(futures)):  # type: ignore[no-untyped-call]
            yield future.result()
    except KilledWorker as error:
        raise ToolError(
            f"workers end while they do {error.task}: look into their logs; they may lack memory, "
            "of which each takes up to memory.max_bytes"
        ) from error
    except CancelledError as error:
        raise ToolError(
            "the scheduler of Dask is gone, or has dropped the work: start it and its workers "
            f"again, and the same command does what is left ({error})"
        ) from error
