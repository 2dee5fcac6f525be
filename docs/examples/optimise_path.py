"""Bend paths away from what is near them (CHOMP, Ratliff et al. 2009)."""

import argparse
import asyncio
from dataclasses import dataclass

import numpy as np
import triquad_client
from numpy.typing import NDArray
from triquad_client import AsyncPinnedMap, Polyline

POINTS = 60  # way points between the ends
STEPS = 150
RATE = 0.02
AVOID = 50.0  # weight of what is near against the path's length
BOWS_M = (-3.0, -1.0, 1.0, 3.0)  # first guesses: how far to the side the middle lies

Places = NDArray[np.float64]
Answers = NDArray[np.float32]


@dataclass(frozen=True)
class Body:
    """What moves along the path."""

    radius_m: float
    margin_m: float  # it keeps away from surfaces and unknown space by so much, where it can


def bowed(start: Places, goal: Places, bow_m: float) -> Places:
    """A bow [POINTS + 2, 3] from start to goal, to the left by ``bow_m``."""
    along = np.linspace(0, 1, POINTS + 2)[:, None]
    left = np.cross([0, 0, 1], goal - start)
    left /= np.linalg.norm(left)
    return start + along * (goal - start) + bow_m * np.sin(np.pi * along) * left


def pull() -> NDArray[np.float64]:
    """The matrix that turns a path [POINTS + 2, 3] into the gradient of its squared length."""
    inner = np.arange(POINTS)
    matrix = np.zeros((POINTS, POINTS + 2))
    matrix[inner, inner + 1] = 2
    matrix[inner, inner] = matrix[inner, inner + 2] = -1
    return matrix


def push(distance: Answers, gradient: Answers, body: Body) -> Places:
    """The gradient [N, 3] of the price of being near: it falls evenly, then smoothly to nothing."""
    gap = distance - body.radius_m
    slope = np.where(gap < 0, -1.0, -np.clip(1 - gap / body.margin_m, 0, 1))
    return slope[:, None] * gradient


async def bend(view: AsyncPinnedMap, path: Places, body: Body) -> Places:
    """Descend from a first guess; one request a step asks for all way points."""
    matrix = pull()
    spread = np.linalg.inv(matrix[:, 1:-1])  # a push at one place moves its neighbours too
    reach_m = body.radius_m + body.margin_m
    for _ in range(STEPS):
        near = await view.query_distance(path[1:-1], reach_m, unknown="obstacle")
        price = push(near.distance_m, near.gradient, body)
        ahead = path[2:] - path[:-2]
        ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
        price -= (price * ahead).sum(axis=1, keepdims=True) * ahead  # aside, not along the path
        slope = matrix @ path + AVOID / POINTS * price
        path[1:-1] -= RATE * spread @ slope
    return path


async def optimise(options: argparse.Namespace) -> None:
    """Bend all guesses at the same time, and print the shortest that is free."""
    body = Body(options.radius, options.margin)
    start, goal = np.array(options.start), np.array(options.goal)
    async with triquad_client.connect_async(options.connect, options.map) as client:
        view = await client.pinned()
        guesses = [bowed(start, goal, bow_m) for bow_m in BOWS_M]
        paths = await asyncio.gather(*(bend(view, path, body) for path in guesses))
        checks: list[Polyline] = await asyncio.gather(
            *(client.query_polyline(path, body.radius_m) for path in paths)
        )
        for bow_m, check in zip(BOWS_M, checks, strict=True):
            free = "free" if check.free() else "not free"
            print(
                f"bow {bow_m:+.0f} m: {check.length_m:.2f} m, clearance {check.clearance_m:.3f} m, "
                f"{free} in epoch {check.epoch}"
            )
        good = [number for number, check in enumerate(checks) if check.free()]
        if not good:
            raise SystemExit("no path is free: plan one first, and bend that")
        best = min(good, key=lambda number: checks[number].length_m)
        print(f"best: bow {BOWS_M[best]:+.0f} m")
        print(paths[best][:: POINTS // 6].round(2))


def main() -> None:
    """Along the pavement of the demo's street, between posts and porches."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--connect", default="tcp/127.0.0.1:7447", metavar="ENDPOINT")
    parser.add_argument("--map", default="demo")
    parser.add_argument("--start", type=float, nargs=3, default=(2.0, -6.0, 1.2), metavar="M")
    parser.add_argument("--goal", type=float, nargs=3, default=(26.0, -6.0, 1.2), metavar="M")
    parser.add_argument("--radius", type=float, default=0.4, help="of the body, metres")
    parser.add_argument("--margin", type=float, default=0.4, help="to keep beyond it, metres")
    asyncio.run(optimise(parser.parse_args()))


if __name__ == "__main__":
    main()
