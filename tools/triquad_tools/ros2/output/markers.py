"""Triangles as ``visualization_msgs/Marker``."""

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from triquad_format.records.arrays import Doubles, Floats

from triquad_tools.sensors.ros.cdr import CdrWriter

_TRIANGLE_LIST = 11
_NAMESPACE = "triquad"
_COLOURS_REPEAT_M = 10.0
_PHASES = np.array([0.0, 1 / 3, 2 / 3])  # of red, green and blue


class Action(IntEnum):
    """The action of a marker."""

    ADD = 0  # or replace
    DELETE = 2
    DELETE_ALL = 3


@dataclass(frozen=True)
class Marker:
    """Triangles that are shown, replaced and deleted together."""

    frame: str
    number: int
    action: Action = Action.ADD
    corners: Doubles = field(default_factory=lambda: np.empty((0, 3)))  # [3 F, 3] map frame

    def payload(self) -> bytes:
        """Return the message, CDR."""
        writer = CdrWriter().numbers("<u4", 0, 0).text(self.frame).text(_NAMESPACE)
        writer.numbers("<i4", self.number, _TRIANGLE_LIST, self.action)
        writer.numbers("<f8", 0, 0, 0, 0, 0, 0, 1, 1, 1, 1)  # pose and scale
        writer.numbers("<f4", 1, 1, 1, 1).numbers("<u4", 0, 0).numbers("u1", False)
        writer.sequence(self.corners.astype("<f8")).sequence(height_colours(self.corners))
        return self._without_texture(writer).payload()

    @staticmethod
    def _without_texture(writer: CdrWriter) -> CdrWriter:
        """Write texture, text and mesh file, of which there are none."""
        nothing = np.empty(0, np.uint8)
        writer.text("").numbers("<u4", 0, 0).text("").text("").sequence(nothing)
        writer.sequence(nothing).text("").text("")
        return writer.text("").sequence(nothing).numbers("u1", False)


def height_colours(points: Doubles) -> Floats:
    """Return red, green, blue and opacity [N, 4] of points [N, 3]; they repeat after ten metres."""
    turns = points[:, 2:] / _COLOURS_REPEAT_M + _PHASES
    colours = np.ones((len(points), 4), "<f4")
    colours[:, :3] = 0.55 + 0.4 * np.cos(2 * np.pi * turns)
    return colours
