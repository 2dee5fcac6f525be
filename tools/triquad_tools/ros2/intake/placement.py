"""The robot's known motion, and sweeps that wait until it tells where they were taken."""

import logging
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from triquad_client.errors import InvalidScanError

from triquad_tools.sensors.motion.frame_graph import ROOT_NAMES
from triquad_tools.sensors.motion.frame_tree import FrameTree
from triquad_tools.sensors.motion.placing import place
from triquad_tools.sensors.motion.track import Transform
from triquad_tools.sensors.sweep import NoScanError, NoTransformError, PosedScan, Sweep

_log = logging.getLogger("triquad_ros2")
_POSES_KEPT = 2000  # of each frame; 20 s at 100 Hz
_MAX_NAME = 256
_CHOICE_S = 1.0  # after a sweep could first be placed, for a better map frame to appear


class Motion:
    """Keeps the transforms that count, within limits: their names come from the network."""

    def __init__(self, *, from_topic: bool, map_frame: str = "") -> None:
        """With ``from_topic``, only a topic of poses gives the motion of the robot's body."""
        self.frames = FrameTree(_POSES_KEPT, map_frame)
        self.body_parent: str | None = None  # in which frame that topic has the body
        self._from_topic = from_topic
        self._body: str | None = None

    def add(self, transforms: list[Transform], *, is_body: bool) -> None:
        """Add transforms, or the pose of the body.

        Raises:
            NoScanError: one of them is of no use; the others were added.
        """
        if is_body and transforms:  # a path may be empty
            self._body, self.body_parent = transforms[0].child, transforms[0].parent
        refusal = None
        for transform in transforms:
            if self._from_topic and not is_body and transform.child == self._body:
                continue
            try:
                if not 0 < len(transform.child) <= _MAX_NAME >= len(transform.parent):
                    raise NoScanError("bad_transform", "its name is empty or too long")
                self.frames.add(transform)
            except (InvalidScanError, NoScanError) as error:
                refusal = NoScanError("bad_transform", f"{transform.child[:_MAX_NAME]}: {error}")
        if refusal is not None:
            raise refusal


@dataclass(frozen=True)
class Placed:
    """A sweep with its outcome: a scan, or why there is none."""

    topic_name: str
    sweep: Sweep
    outcome: PosedScan | NoScanError


@dataclass
class _Waiting:
    topic_name: str
    sweep: Sweep
    needs_ns: tuple[int, int]  # first and last time at which the sensor's pose is needed
    give_up_s: float  # monotonic
    is_over: bool = False  # time went back before its stamp, so its transforms come no more


@dataclass
class Placement:
    """Places sweeps in the map frame, those of each topic in the order in which they came."""

    motion: Motion  # which others extend meanwhile, on the same thread
    map_frame: str  # without one it is chosen, once, as the transforms come
    max_bytes: int  # of all sweeps that wait
    timeout_s: float  # for how long each waits

    def __post_init__(self) -> None:
        self._waiting: dict[str, deque[_Waiting]] = {}
        self._warned = bool(self.map_frame)  # that there is a better frame; not where it was chosen
        self._choose_s: float | None = None  # when the map frame is chosen at the latest

    def add(self, topic_name: str, sweep: Sweep, now_s: float) -> None:
        """Have a sweep placed; if too many are pending, the oldest are dropped."""
        entry = _Waiting(topic_name, sweep, sweep.span_ns, now_s + self.timeout_s)
        self._waiting.setdefault(topic_name, deque()).append(entry)
        self._keep_within_limit(now_s)

    def give_up_after(self, topic_name: str, stamp_ns: int) -> None:
        """Drop pending sweeps of a topic that lie after a time to which it went back."""
        for entry in self._waiting.get(topic_name, ()):
            entry.is_over = entry.is_over or entry.sweep.stamp_ns > stamp_ns

    def settle(self, now_s: float) -> Iterator[Placed]:
        """Return the sweeps that are no longer pending, with their outcome."""
        for topic_name, entries in list(self._waiting.items()):
            while entries and (placed := self._try(entries[0], now_s)) is not None:
                entries.popleft()
                yield placed
            if not entries:
                del self._waiting[topic_name]

    def _keep_within_limit(self, now_s: float) -> None:
        entries = [entry for entries in self._waiting.values() for entry in entries]
        excess = sum(entry.sweep.memory_bytes for entry in entries) - self.max_bytes
        for entry in sorted(entries, key=lambda entry: entry.give_up_s):
            if excess <= 0:
                return
            entry.give_up_s = min(entry.give_up_s, now_s)
            excess -= entry.sweep.memory_bytes

    def _try(self, entry: _Waiting, now_s: float) -> Placed | None:
        """Return the outcome of a sweep; None while it is pending."""
        try:
            outcome: PosedScan | NoScanError = self._scan(entry, now_s)
        except NoTransformError as error:
            if error.late and entry.is_over:
                text = "time went back before its transforms came, or its stamp was wrong"
                outcome = NoScanError("restarted", text)
            elif error.late and now_s < entry.give_up_s:
                return None
            else:
                outcome = error
        except NoScanError as error:
            outcome = error
        except Exception as error:  # whatever numbers came must not stop the others
            outcome = NoScanError("internal", repr(error))
        return Placed(entry.topic_name, entry.sweep, outcome)

    def _scan(self, entry: _Waiting, now_s: float) -> PosedScan:
        frame = entry.sweep.frame
        target = self.map_frame or self._best_frame(frame, now_s)
        frames = self.motion.frames
        if frame not in (target, *ROOT_NAMES):
            # Asked first, since it is quick, and most that wait will wait on.
            frames.poses(target, frame, np.array(entry.needs_ns, np.int64))
        if frame in (target, *ROOT_NAMES) or frames.is_world(target, frame):
            raise NoScanError(
                "registered",
                f"the cloud is in the frame {frame!r}, so where the sensor was is not known: "
                "choose the topic of the sensor itself with --clouds",
            )
        scan = place(entry.sweep, frames, target)
        if not self.map_frame:
            _log.info("mapping in the frame %r", target)
            self.map_frame = target
        self._warn_of_better_frame()
        return scan

    def _warn_of_better_frame(self) -> None:
        better = self.motion.frames.fixed_frame(self.map_frame)
        if better != self.map_frame and not self._warned:
            self._warned = True
            told = "%r turned up above %r, in which the map is made: to map in it, use --map-frame "
            _log.warning(told + "%s with an empty map", better, self.map_frame, better)

    def _best_frame(self, frame: str, now_s: float) -> str:
        """Return the frame to map in, as far as is known by now."""
        if self.motion.body_parent is not None:
            return self.motion.body_parent
        found = self.motion.frames.fixed_frame(frame)
        if found not in ROOT_NAMES:
            above = f"it is in {found!r}" if found != frame else "no transform names it"
            if found == frame and frame in self.motion.frames.frames:
                above = "it is in no other"
            raise NoTransformError(
                "no_transform",
                f"{frame!r} is in none of the frames {', '.join(ROOT_NAMES)}: {above}",
                late=True,
            )
        if self._choose_s is None:
            self._choose_s = now_s + min(_CHOICE_S, self.timeout_s / 2)
        if found != ROOT_NAMES[0] and now_s < self._choose_s:
            raise NoTransformError("no_transform", f"no frame above {found!r} yet", late=True)
        return found
