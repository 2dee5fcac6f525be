"""A short episode: a box stands on a street, then is gone."""

from triquad_tools.simulation.lidar import Lidar, SimulatedDrive, drive
from triquad_tools.simulation.scene import Scene
from triquad_tools.simulation.solids import box
from triquad_tools.simulation.street import street

from bench.scenes.episodes import Episode, Things, straight_lane, thin_things


def box_on_a_street(busy: int, empty: int, rain: float = 0.0) -> Episode:
    """Return as many scans of a coarse lidar with the box in the lane, and without it."""
    thin = tuple(thin_things(6.0, -2.5))
    bare = street(1)
    scene = Scene((*bare.solids, *thin), bare.bounds, bare.drive_length_m)
    poses = drive(scene, busy + empty, 0.15)
    standing = SimulatedDrive(scene, Lidar(beams=32, columns=512), poses, 1)

    def things(_time_s: float) -> Things:
        return {"box": [box((12.0, 1.6, 0.8), (2.0, 0.8, 0.7), 0.0, 0.1)]}

    lane = straight_lane((5.0, 20.0), 1.6, 0.6)
    return Episode("a street", standing, things, busy, lane, thin, rain=rain)
