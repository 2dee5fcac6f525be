"""Several recordings of one frame, one after the other, as one recording."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate

from triquad_tools.recordings.folders.scan_folder import ScanFolder
from triquad_tools.recordings.recording import ScanEntry
from triquad_tools.recordings.ros_recording import RosRecording
from triquad_tools.recordings.scan_log import ScanLogRecording
from triquad_tools.sensors.sweep import PosedScan


@dataclass(frozen=True)
class RecordingChain:
    """The scans of several recordings, whose poses have to be in the same frame."""

    recordings: Sequence[RosRecording | ScanFolder | ScanLogRecording]

    @property
    def entries(self) -> Sequence[ScanEntry]:
        """The scans that can be mapped, recording by recording."""
        return [entry for recording in self.recordings for entry in recording.entries]

    def read(self, indices: Sequence[int]) -> Iterator[PosedScan]:
        """Yield the scans of these numbers, which rise."""
        ends = list(accumulate(len(recording.entries) for recording in self.recordings))
        for recording, first, end in zip(self.recordings, [0, *ends], ends, strict=False):
            if own := [index - first for index in indices if first <= index < end]:
                yield from recording.read(own)
