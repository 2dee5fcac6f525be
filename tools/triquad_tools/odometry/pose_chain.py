"""Poses of which each is known by the one before, and some by one long before: loops.

What a loop is off is spread over the steps within it, by least squares: each step may be wrong by
some noise that grows with its length (in closed form, as in COP-SLAM: Dubbelman and Browning,
T-RO 2015; relinearised, with Cauchy's weights of loops that contradict the others). A library for
graphs of poses would need as many lines, and 110 MB.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from triquad_format.records.arrays import Doubles, Longs

_STEP_DEG, _STEP_M = 0.1, 0.02
"""Standard deviation of a way of one metre; it grows with the root of its length. Of simulated
streets with 16 beams the way is off by 8 times as much at most, with 64 beams by a hundredth."""

_LOOP_DEG, _LOOP_M = 0.2, 0.05  # standard deviation of what closes a loop
_CONTRADICTED = 3.0  # deviations from which on a loop that contradicts others counts less
_ROUNDS = 6


class Loop(NamedTuple):
    """A pose that is known by one long before it."""

    before: int
    after: int
    before_from_after: Doubles  # [4, 4]


def closed(chain: Doubles, loops: list[Loop]) -> Doubles:
    """Return the poses of a chain [N, 4, 4] as they are with its loops closed; the first stays."""
    before, after = (np.array([loop[end] for loop in loops], np.int64) for end in (0, 1))
    measured = np.array([loop.before_from_after for loop in loops])
    noise = _step_noise(chain)
    # How much two loops have in common: the noise of the steps within both.
    sums = np.cumsum(noise, axis=0)
    first, last = np.maximum.outer(before, before), np.minimum.outer(after, after)
    shared = np.where((last > first)[:, :, None, None], sums[last] - sums[first], 0.0)
    of_loops = _moved_to(chain[after, :3, 3], _LOOP_DEG, _LOOP_M)
    to_places = np.linalg.inv(_carried(chain[after, :3, 3]))
    undone, steps = np.linalg.inv(chain[after]), np.zeros((len(chain), 6))
    moves, weights = np.tile(np.eye(4), (len(chain), 1, 1)), np.ones(len(loops))
    for number in range(_ROUNDS):
        there = moves[before] @ chain[before] @ measured
        off = _twists(np.linalg.inv(moves[after]) @ there @ undone)
        if number:
            at_places = (to_places @ off[:, :, None])[:, :, 0]
            weights = 1 / (1 + _squares(at_places) / _CONTRADICTED**2)
        total = np.cumsum(steps, axis=0)
        system = shared.copy()
        system[range(len(loops)), range(len(loops))] += of_loops / weights[:, None, None]
        system = system.transpose(0, 2, 1, 3).reshape(6 * len(loops), -1)
        wanted = (off + total[after] - total[before]).reshape(-1)
        pulls = np.linalg.solve(system, wanted).reshape(-1, 6)
        steps = (noise @ _within(pulls, before, after, len(chain))[:, :, None])[:, :, 0]
        moves = _products(_small_moves(steps))
    result: Doubles = moves @ chain
    return result


def surprise(chain: Doubles, loop: Loop) -> float:
    """Return by how many standard deviations of the way between them a loop moves its later pose.

    ``chain`` [N, 4, 4] are the poses as they are known before.
    """
    place = chain[loop.after].copy()
    place[:3, :3] = np.eye(3)
    local = np.linalg.inv(place) @ chain[loop.before : loop.after + 1]
    noise = _step_noise(local).sum(axis=0) + _moved_to(np.zeros((1, 3)), _LOOP_DEG, _LOOP_M)[0]
    off = _twists((local[0] @ loop.before_from_after @ np.linalg.inv(local[-1]))[None])[0]
    return float(np.sqrt(off @ np.linalg.solve(noise, off)))


def is_news(chain: Doubles, loop: Loop) -> bool:
    """Return whether a loop says more of poses [N, 4, 4] than that they are right."""
    place = chain[loop.after]
    off = np.linalg.inv(place) @ chain[loop.before] @ loop.before_from_after
    return bool(_squares(_twists(off[None]))[0] > 1)


def _step_noise(chain: Doubles) -> Doubles:
    """Return the covariances [N, 6, 6] of the steps to each pose, as twists about the origin."""
    places = chain[:, :3, 3]
    lengths = np.linalg.norm(np.diff(places, axis=0, prepend=places[:1]), axis=1)
    noise: Doubles = _moved_to(places, _STEP_DEG, _STEP_M) * lengths[:, None, None]
    return noise


def _moved_to(places: Doubles, turn_deg: float, shift_m: float) -> Doubles:
    """Return covariances [N, 6, 6] of twists about the origin, of turns and shifts at places."""
    carried = _carried(places)
    noise = np.diag([np.radians(turn_deg) ** 2] * 3 + [shift_m**2] * 3)
    moved: Doubles = carried @ noise @ carried.transpose(0, 2, 1)
    return moved


def _carried(places: Doubles) -> Doubles:
    """Return the matrices [N, 6, 6] from turns and shifts at places [N, 3] to the origin."""
    x, y, z = places.T
    matrices: Doubles = np.tile(np.eye(6), (len(places), 1, 1))
    matrices[:, 3, 1], matrices[:, 3, 2] = -z, y
    matrices[:, 4, 0], matrices[:, 4, 2] = z, -x
    matrices[:, 5, 0], matrices[:, 5, 1] = -y, x
    return matrices


def _twists(moves: Doubles) -> Doubles:
    """Return turns, radians, and shifts, metres, [N, 6] of small moves [N, 4, 4]."""
    turns = Rotation.from_matrix(moves[:, :3, :3]).as_rotvec()
    twists: Doubles = np.hstack([turns, moves[:, :3, 3]])
    return twists


def _small_moves(twists: Doubles) -> Doubles:
    moves: Doubles = np.tile(np.eye(4), (len(twists), 1, 1))
    moves[:, :3, :3] = Rotation.from_rotvec(twists[:, :3]).as_matrix()
    moves[:, :3, 3] = twists[:, 3:]
    return moves


def _products(moves: Doubles) -> Doubles:
    """Return the product [N, 4, 4] of each move with all before it."""
    products: Doubles = moves.copy()
    for number in range(1, len(moves)):
        products[number] = products[number - 1] @ moves[number]
    return products


def _within(pulls: Doubles, before: Longs, after: Longs, count: int) -> Doubles:
    """Return the sums [count, 6] of what loops pull at each step that lies within them."""
    sums = np.zeros((count + 1, 6))
    np.add.at(sums, before + 1, pulls)
    np.add.at(sums, after + 1, -pulls)
    return np.cumsum(sums, axis=0)[:count]


def _squares(off: Doubles) -> Doubles:
    """Return the squared deviations [L] of what loops are off [L, 6], at their places."""
    squares: Doubles = ((off / ([np.radians(_LOOP_DEG)] * 3 + [_LOOP_M] * 3)) ** 2).sum(axis=1)
    return squares
