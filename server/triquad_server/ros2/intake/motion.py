"""What is known of how the robot moves, from transforms or from a topic of poses."""

from triquad_sensors.errors import InvalidScanError, NoScanError
from triquad_sensors.motion.frame_tree import FrameTree, Transform

_POSES_KEPT = 2000  # of each frame; 20 s at 100 Hz
_MAX_FRAMES = 1000
_MAX_NAME = 256


class Motion:
    """Keeps the transforms that count, within limits: their names come from the network."""

    def __init__(self, *, from_topic: bool) -> None:
        """``from_topic``: a topic of poses tells how the robot's body moves, no other may."""
        self.frames = FrameTree(_POSES_KEPT)
        self.body_parent: str | None = None  # in which frame that topic has the body
        self._from_topic = from_topic
        self._body: str | None = None

    def add(self, transforms: list[Transform], *, is_body: bool) -> None:
        """Take in transforms, or the pose of the body.

        Raises:
            NoScanError: one of them is of no use; the others were taken in.
        """
        if is_body:
            self._body, self.body_parent = transforms[0].child, transforms[0].parent
        refusal = None
        for transform in transforms:
            if self._from_topic and not is_body and transform.child == self._body:
                continue
            try:
                self._check(transform)
                self.frames.add(transform)
            except (InvalidScanError, NoScanError) as error:
                refusal = NoScanError("bad_transform", f"{transform.child[:_MAX_NAME]}: {error}")
        if refusal is not None:
            raise refusal

    def _check(self, transform: Transform) -> None:
        if max(len(transform.parent), len(transform.child)) > _MAX_NAME or not transform.child:
            raise NoScanError("bad_transform", "its name is empty or too long")
        if len(self.frames) >= _MAX_FRAMES and not self.frames.knows(transform.child):
            raise NoScanError("bad_transform", f"more than {_MAX_FRAMES} frames")
