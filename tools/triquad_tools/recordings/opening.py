"""Finding out what kind of recording a path is, and choosing the part that is to be mapped."""

import argparse
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from itertools import islice
from pathlib import Path

from triquad_tools.console.arguments import MAP_SUFFIX, Place
from triquad_tools.console.command import ToolError, print_remark
from triquad_tools.recordings.arguments import WORLD
from triquad_tools.recordings.chain import RecordingChain
from triquad_tools.recordings.cloud import points_in_range
from triquad_tools.recordings.folders.cloud_folder import is_cloud_folder, read_cloud_folder
from triquad_tools.recordings.folders.depth_folder import is_depth_folder, read_depth_folder
from triquad_tools.recordings.folders.point_file import POINT_SUFFIXES
from triquad_tools.recordings.folders.scan_folder import ScanFolder
from triquad_tools.recordings.mcap_bag import find_bag
from triquad_tools.recordings.recording import ReadingOptions, ScanEntry, options_of
from triquad_tools.recordings.ros_recording import RosRecording
from triquad_tools.recordings.scan_log import ScanLogRecording, find_scan_log, read_scan_log
from triquad_tools.sensors.ray_check import as_rays
from triquad_tools.sensors.sweep import PosedScan

_UNPACK = {
    ".zip": "unzip", ".7z": "7z x", ".tar": "tar -xf", ".tgz": "tar -xf", ".tar.gz": "tar -xf",
    ".tar.bz2": "tar -xf", ".tar.xz": "tar -xf", ".tar.zst": "tar -xf", ".gz": "gunzip",
    ".bz2": "bunzip2", ".xz": "unxz", ".zst": "unzstd", ".zstd": "unzstd", ".lz4": "unlz4",
}  # fmt: skip
"""The commands that unpack files, by how their names end: the first one counts."""

Recording = RosRecording | ScanFolder | ScanLogRecording
"""Checked as a whole, so that its errors are known."""

_MOST_NAMED = 10  # recordings in a folder
_MOST_SEARCHED = 1000  # files and folders
_DEEP = "*", "*/*", "*/*/*"  # where recordings in a folder are searched for

_ORIGIN = 0.0, 0.0, 0.0

_FLAGS = {"transforms": "--transform", "deskew": "--no-deskew", "loops": "--no-loops"}
"""The flags whose names are not those of the choices that they set."""

_OF_BAGS = {
    "topics", "poses", "map_frame", "body_frame", "transforms", "recorder_clock", "stride",
    "points_in", "ray_origin", "deskew", "units_per_metre", "trajectory", "quaternion", "odometry",
    "loops",
}  # fmt: skip
_OF_DEPTH = {"trajectory", "quaternion", "intrinsics", "units_per_metre", "stride"}
_OF_CLOUDS = {
    "trajectory", "odometry", "loops", "quaternion", "points_in", "columns", "ray_origin", "deskew",
}  # fmt: skip
"""The choices that mean something for each kind of recording."""


def open_recording(path: Path, options: ReadingOptions) -> Recording:
    """Return a recording, after all of it was checked.

    Raises:
        ToolError: there is none, it is damaged, or does not hold what ``options`` ask for.
    """
    if not path.exists():
        raise ToolError(f"{path}: no such file or folder")
    _refuse_contradictions(options)
    if (log := find_scan_log(path)) is not None:
        _refuse_others(f"{path} has the scans of a map", set(), options)
        return read_scan_log(log)
    bag = find_bag(path)
    if bag is not None:
        _refuse_others(f"{path} is a bag", _OF_BAGS, options)
        return RosRecording(bag, options)
    if is_depth_folder(path):
        _refuse_others(f"{path} is a folder of depth images", _OF_DEPTH, options)
        return read_depth_folder(path, options)
    if is_cloud_folder(path):
        _refuse_others(f"{path} is a folder of clouds", _OF_CLOUDS, options)
        return read_cloud_folder(path, options)
    ends = (command for end, command in _UNPACK.items() if path.name.lower().endswith(end))
    if path.is_file() and (command := next(ends, None)):
        raise ToolError(f"{path}: is packed: unpack it with '{command} {path}' first")
    if path.suffix == MAP_SUFFIX:
        raise ToolError(f"{path}: is a map, not a recording: triquad-pack makes a mesh of it")
    within = next(filter(None, map(partial(_within, path), _DEEP)), [])
    there = "a bag of ROS, an MCAP file, or a folder as docs/tools.md describes them"
    if path.is_dir():
        there += f" (with clouds, {', '.join(POINT_SUFFIXES)}, or depth images, .png)"
    if within:
        there = f"one of the recordings in it, {', '.join(within[:_MOST_NAMED])}"
    if len(within) > 1:
        there += "; files of one that follow each other in time may lie in one folder"
    raise ToolError(f"{path}: no recording that is understood: give {there}")


def _within(path: Path, pattern: str) -> list[str]:
    """Return the recordings that some of the folders in one are."""
    kinds = find_bag, is_depth_folder, is_cloud_folder
    folders = (each for each in islice(path.glob(pattern), _MOST_SEARCHED) if each.is_dir())
    return sorted(str(each) for each in folders if any(is_one(each) for is_one in kinds))


def _refuse_contradictions(options: ReadingOptions) -> None:
    if options.odometry and (options.trajectory or options.poses):
        raise ToolError("--odometry finds the poses, so --trajectory and --poses mean nothing")
    if options.odometry and options.points_in == WORLD:
        raise ToolError(
            "--odometry needs points in the frame of their sensor, not --points-in world"
        )
    if not (options.odometry or options.loops):
        raise ToolError("--no-loops says how --odometry finds the poses: give that, too")
    if options.trajectory and options.poses:
        raise ToolError("--trajectory and --poses both say which poses to take: leave one out")


def _refuse_others(what: str, meaningful: set[str], options: ReadingOptions) -> None:
    for choice in fields(options):
        name, is_given = choice.name, getattr(options, choice.name) != choice.default
        if is_given and name not in meaningful:
            flag = _FLAGS.get(name, f"--{name.replace('_', '-')}")
            raise ToolError(f"{what}, for which {flag} means nothing: leave it out")


@dataclass(frozen=True)
class Selection:
    """Some scans of a recording, without points that are too near."""

    recording: Recording | RecordingChain
    indices: Sequence[int]
    range_min_m: float
    ray_origin: Place  # in the frame of the points
    way: str  # in which it is read: another one may give other scans

    def __len__(self) -> int:
        return len(self.indices)

    @property
    def entries(self) -> list[ScanEntry]:
        """The time and sensor of each scan."""
        entries = self.recording.entries
        return [entries[index] for index in self.indices]

    def scans(self, start: int = 0) -> Iterator[PosedScan]:
        """Yield the scans from number ``start`` on, one after the other."""
        return self.read(range(start, len(self)))

    def read(self, numbers: Sequence[int]) -> Iterator[PosedScan]:
        """Yield the scans of these numbers, which rise."""
        for scan in self.recording.read([self.indices[number] for number in numbers]):
            seen = as_rays(scan, self.ray_origin)
            yield replace(seen, points=points_in_range(seen.points, self.range_min_m))


def open_selected(options: argparse.Namespace) -> Selection:
    """Return the recordings of the arguments and the scans they choose; their remarks are printed.

    Raises:
        ToolError: one cannot be read, or no scan of it is left to map.
    """
    reading, paths = options_of(options), options.recordings
    if len(paths) > 1 and (reading.odometry or reading.trajectory):
        flag = "--odometry" if reading.odometry else "--trajectory"
        raise ToolError(
            f"{flag} gives each of {len(paths)} recordings poses in a frame of its own: map them "
            "one by one, or give recordings that have poses in one frame"
        )
    parts = [_part(path, reading, options) for path in paths]
    way = repr(([path.resolve() for path in paths], reading, options.range_min))
    origin, range_min_m = reading.ray_origin or _ORIGIN, options.range_min
    if len(parts) == 1:
        return Selection(*parts[0], range_min_m, origin, way)
    chosen, before = list[int](), 0
    for recording, indices in parts:
        chosen += [before + index for index in indices]
        before += len(recording.entries)
    chain = RecordingChain([recording for recording, _ in parts])
    return Selection(chain, chosen, range_min_m, origin, way)


def _part(
    path: Path, reading: ReadingOptions, options: argparse.Namespace
) -> tuple[Recording, list[int]]:
    """Return a recording and the numbers of its scans that are chosen.

    Raises:
        ToolError: it cannot be read, or no scan is left to map.
    """
    recording = open_recording(path, reading)
    for remark in recording.remarks:
        print_remark(f"{path}: {remark}")
    entries = entries_of(recording, path)
    indices = _chosen(entries, options)
    if not indices:
        raise ToolError(
            f"{path}: no scan is left of {len(entries)} in {length_s(entries):.1f} s: see --start, "
            "--end and --every"
        )
    return recording, indices


def entries_of(recording: Recording, path: Path) -> Sequence[ScanEntry]:
    """Return the scans of a recording that can be mapped.

    Raises:
        ToolError: there are none.
    """
    if entries := recording.entries:
        return entries
    raise ToolError(f"{path}: nothing of it can be mapped as it is")


def length_s(entries: Sequence[ScanEntry]) -> float:
    """Return the seconds between the first and the last of some scans."""
    stamps = [entry.stamp_ns for entry in entries]
    return (max(stamps) - min(stamps)) / 1e9


def _chosen(entries: Sequence[ScanEntry], options: argparse.Namespace) -> list[int]:
    first_ns = min(entry.stamp_ns for entry in entries)
    end_s = float("inf") if options.end is None else options.end
    before: Counter[str] = Counter()  # scans of each sensor
    chosen: list[int] = []
    for index, entry in enumerate(entries):
        nth = before[entry.source] % options.every == 0
        before[entry.source] += 1
        timely = options.start <= (entry.stamp_ns - first_ns) / 1e9 <= end_s
        if nth and timely:
            chosen.append(index)
    return chosen
