"""Warnings about scans: what goes wrong with those of each source, and which setting helps."""

import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_format.records.plausibility import jumps, median_range_m, wrong_units
from triquad_format.wire.messages import Scan

from triquad_server.intake.pose_check import PoseCheck
from triquad_server.intake.rays import ScanRays
from triquad_server.intake.scan_queue import ScanQueue
from triquad_server.settings import ANY_SOURCE, Settings

_log = logging.getLogger(__name__)

_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 30.0, 3600.0
"""The first and the longest pause between two warnings of one cause and source; it doubles."""

_STANDS_S = 60.0  # how long clients are shown a warning after its cause was last met
_SCANS = 10  # scans of a source that are judged together
_TOO_NEAR_SHARE, _TOO_FAR_SHARE = 0.1, 0.5
"""The shares of points above which their loss is reported. Points too far still show free space."""
_MAX_SOURCES = 256  # sources that are kept; the one heard of longest ago is removed
_MAX_WARNINGS = 1024  # warnings that are kept, the same way
_MAX_SHOWN = 50  # warnings for a client at once

_NEAR_LEAVES, _GOOD_LEAVES = 18.0, 40.0
"""The median ranges that are too near for the leaf, and that suit it: lidars in streets have 28 to
55 leaves with the presets for them, sensors in rooms 15 with the leaf of streets."""

_TABLETOP_LEAF_M = 0.035  # finer leaves than this are those of the preset tabletop


@dataclass
class _Points:
    scans: int = 0
    sent: int = 0
    dropped: dict[str, int] = field(default_factory=lambda: {"too_near": 0, "too_far": 0})
    ranges_m: list[float] = field(default_factory=list)  # median of each scan, of what is used
    sent_ranges_m: list[float] = field(default_factory=list)  # the same of all that was sent
    places: list[tuple[int, Doubles]] = field(default_factory=list)  # stamp and place of each scan
    poses: PoseCheck = field(default_factory=PoseCheck)  # which goes on with the scans after these


@dataclass
class _Warning:
    text: str
    due_s: float  # monotonic: not logged again before
    pause_s: float
    met_s: float  # when its cause was last met


class ScanWarnings:
    """Logs and keeps warnings, each cause of each source with pauses; safe for any thread."""

    def __init__(
        self, scans: ScanQueue, settings: Settings, now: Callable[[], float] = time.monotonic
    ) -> None:
        """Watch a queue; ``now`` is a monotonic clock, seconds."""
        self._scans = scans
        self._settings = settings
        self._now = now
        self._lock = threading.Lock()
        self._points: OrderedDict[str, _Points] = OrderedDict()
        self._counted: dict[tuple[str, str], int] = {}  # scans so far, by source and cause
        # By source and cause, the newest last.
        self._warnings: OrderedDict[tuple[str, str], _Warning] = OrderedDict()

    def add(self, scan: Scan, rays: ScanRays) -> None:
        """Record that a scan was taken in; ``rays`` are what of it is used."""
        source, sent = scan.source, scan.points
        with self._lock:
            points = self._points.setdefault(source, _Points())
            self._points.move_to_end(source)
            if len(self._points) > _MAX_SOURCES:
                self._points.popitem(last=False)
            points.scans += 1
            points.sent += len(sent)
            points.sent_ranges_m.append(median_range_m(sent))
            points.places.append((scan.stamp_ns, rays.origin))
            for reason in points.dropped:
                points.dropped[reason] += rays.points_dropped.get(reason, 0)
            if len(rays.ends):
                points.ranges_m.append(median_range_m(rays.ends, rays.origin))
                points.poses.see(rays, scan.world_from_sensor[:3, :3])

    def check(self) -> None:
        """Log the warnings that are due and were not logged lately."""
        with self._lock:
            self._check_scans()
            for source, points in self._points.items():
                poses = points.poses
                if points.scans >= _SCANS:
                    if self._check_units(source, points):
                        poses = PoseCheck()
                    else:
                        self._check_ranges(source, points)
                        self._check_leaf(source, points)
                        self._check_places(source, points)
                    self._points[source] = _Points(poses=poses)
                if (told := poses.problem()) is not None:
                    self._warn(source, "poses", told)
                    self._points[source].poses = PoseCheck()  # these may be right from now on

    def of(self, source: str) -> tuple[str, ...]:
        """Return the current warnings about a source."""
        self.check()
        return self._current(lambda of_source: of_source == source)

    def all(self) -> tuple[str, ...]:
        """Return all current warnings."""
        return self._current(lambda _: True)

    def _current(self, wanted: Callable[[str], bool]) -> tuple[str, ...]:
        with self._lock:
            since_s = self._now() - _STANDS_S
            texts = [
                warning.text
                for (source, _), warning in self._warnings.items()
                if wanted(source) and warning.met_s >= since_s
            ]
        return tuple(texts[-_MAX_SHOWN:])

    def _check_scans(self) -> None:
        thin_m, leaf_m = self._settings.scan.thin_m, self._settings.field.leaf_m
        before, self._counted = self._counted, {}
        for source, counts in self._scans.ledger.by_source().items():
            for cause, count, text in (
                (
                    "never arrived",
                    counts.never_arrived,
                    "of its scans never arrived: the link broke, or they were published before "
                    "this server started",
                ),
                (
                    "lost",
                    counts.pushed_out,
                    f"of its scans were lost, since the server does not keep up: publish fewer, or "
                    f"fewer points a scan, or set a larger scan.thin_m (it is {thin_m:g}) or, for "
                    f"a new map, field.leaf_m (it is {leaf_m:g})",
                ),
                (
                    "refused",
                    counts.refused,
                    f"of its scans were refused, the last since {counts.last_refusal}",
                ),
            ):
                self._counted[source, cause] = count
                if count > before.get((source, cause), 0):
                    self._warn(source, cause, f"{count} {text}")

    def _check_ranges(self, source: str, points: _Points) -> None:
        own = self._settings.sources.get(source, ANY_SOURCE)
        scan = self._settings.scan_of(own)
        for reason, key, less, most in (
            ("too_near", "range_min_m", "less", _TOO_NEAR_SHARE),
            ("too_far", "range_max_m", "more", _TOO_FAR_SHARE),
        ):
            share = points.dropped[reason] / max(1, points.sent)
            # What is set for the source is intended, and so is a background that is cut off.
            meant = getattr(own, key) is not None or (
                reason == "too_far" and key in self._settings.scan.model_fields_set
            )
            if share <= most or meant:
                continue
            limit_m = getattr(scan, key)
            self._warn(
                source,
                reason,
                f"{key} = {limit_m:g} drops {100 * share:.0f} % of its points: set scan.{key} or "
                f"sources.{source}.{key} to {less}, or the latter to {limit_m:g} if this is meant",
            )

    def _check_leaf(self, source: str, points: _Points) -> None:
        if not points.ranges_m:
            return
        range_m, leaf_m = float(np.median(points.ranges_m)), self._settings.field.leaf_m
        if range_m >= _NEAR_LEAVES * leaf_m:
            return
        better_m = float(f"{range_m / _GOOD_LEAVES:.1g}")
        preset = "tabletop" if better_m < _TABLETOP_LEAF_M else "indoor"
        self._warn(
            source,
            "leaf",
            f"what it sees is {range_m:.2g} m away (median), near for field.leaf_m = {leaf_m:g}: "
            f"details are lost. For a new map use --preset {preset}, or field.leaf_m = "
            f"{better_m:g}",
        )

    def _check_units(self, source: str, points: _Points) -> bool:
        """Return whether points or poses are not in metres, where all else would mislead."""
        range_m = float(np.median(points.sent_ranges_m))
        told = wrong_units(range_m, np.array([place for _, place in points.places]))
        if told is not None:
            self._warn(source, "units", told)
        return told is not None

    def _check_places(self, source: str, points: _Points) -> None:
        stamps, places = zip(*sorted(points.places, key=lambda one: one[0]), strict=True)
        times = np.array(stamps) + np.arange(len(stamps))  # ns: equal ones follow each other
        count, size_m = jumps(times, np.array(places))
        if count:
            self._warn(
                source,
                "jumps",
                f"its poses jump to and fro by {size_m:.2g} m: two programs publish them, or two "
                "sensors scans of this name: stop one, or give each a source of its own",
            )

    def _warn(self, source: str, cause: str, text: str) -> None:
        """Report that the cause of a warning was met just now; log it if it was not lately."""
        now, key = self._now(), (source, cause)
        text = f"source {source!r}: {text}"
        before = self._warnings.get(key)
        if before is not None and now < before.due_s:
            before.met_s, before.text = now, text
            return
        pause_s = _FIRST_PAUSE_S if before is None else min(2 * before.pause_s, _LONGEST_PAUSE_S)
        self._warnings[key] = _Warning(text, now + pause_s, pause_s, met_s=now)
        self._warnings.move_to_end(key)
        if len(self._warnings) > _MAX_WARNINGS:
            self._warnings.popitem(last=False)
        _log.warning("%s", text)
