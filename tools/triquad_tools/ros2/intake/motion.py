"""The robot's known motion, from transforms or from a topic of poses."""

from triquad_client.errors import InvalidScanError

from triquad_tools.sensors.motion.frame_tree import STATIC, FrameTree, Transform
from triquad_tools.sensors.sweep import NoScanError

RESTART_NS = 10 * 10**9
"""Transforms that go back by more are of a simulation or a bag that was started again."""

_POSES_KEPT = 2000  # of each frame; 20 s at 100 Hz
_MAX_FRAMES = 1000
_MAX_NAME = 256


class Motion:
    """Keeps the transforms that count, within limits: their names come from the network."""

    def __init__(self, *, from_topic: bool) -> None:
        """With ``from_topic``, only a topic of poses gives the motion of the robot's body."""
        self.frames = FrameTree(_POSES_KEPT)
        self.body_parent: str | None = None  # in which frame that topic has the body
        self._from_topic = from_topic
        self._body: str | None = None

    def add(self, transforms: list[Transform], *, is_body: bool) -> None:
        """Add transforms, or the pose of the body.

        Raises:
            NoScanError: one of them is of no use; the others were added.
        """
        if is_body:
            self._body, self.body_parent = transforms[0].child, transforms[0].parent
        refusal = None
        for transform in transforms:
            if self._from_topic and not is_body and transform.child == self._body:
                continue
            try:
                self._check(transform)
                if transform.stamp_ns is not STATIC:
                    self._forget_after(transform.child, transform.stamp_ns)
                self.frames.add(transform)
            except (InvalidScanError, NoScanError) as error:
                refusal = NoScanError("bad_transform", f"{transform.child[:_MAX_NAME]}: {error}")
        if refusal is not None:
            raise refusal

    def forget_after(self, stamp_ns: int) -> None:
        """Remove poses from before time went back to a stamp."""
        for child in self.frames.moving:
            self._forget_after(child, stamp_ns)

    def _forget_after(self, child: str, stamp_ns: int) -> None:
        """Remove the poses of a frame whose time goes back to a stamp."""
        newest_ns = self.frames.newest_ns(child)
        if newest_ns is not None and newest_ns > stamp_ns + RESTART_NS:
            self.frames.forget(child)

    def _check(self, transform: Transform) -> None:
        if max(len(transform.parent), len(transform.child)) > _MAX_NAME or not transform.child:
            raise NoScanError("bad_transform", "its name is empty or too long")
        if len(self.frames) >= _MAX_FRAMES and not self.frames.knows(transform.child):
            raise NoScanError("bad_transform", f"more than {_MAX_FRAMES} frames")
