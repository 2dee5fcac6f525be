"""Make ``docs/paper.md``: the experiments of the 3QFP paper, in worlds of our own.

VDBFusion and Open3D are run as well where they are installed: both have wheels for Python 3.10.
"""

import argparse
import os
import platform
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image
from triquad_client import Mesh
from triquad_tools.commands.evaluate import main as evaluate
from triquad_tools.recordings.cloud import merged
from triquad_tools.simulation.lidar import Lidar, SimulatedDrive
from triquad_tools.simulation.street import street_drive

from bench.driven import write_recording
from bench.paper.quad import quad_walk

PICTURES = ("sparse.png", "memory.png", "holes.png")
"""The pictures of each report."""

WORLDS = ("maicity", "newer-college", "noisy")
"""The keys of the worlds, in the names of their pictures."""

_COLOURS = 256  # of a picture on the page: a third of the bytes
_DOCS = Path(__file__).parents[2] / "docs"
_SPACING_M = 0.03  # of the truth: 2 cm would have twice as many points
_TRUE_BEAMS, _TRUE_COLUMNS = 256, 4096  # of the sensor that looks for the truth


@dataclass(frozen=True)
class _World:
    """A world, and the set of the paper that it is like."""

    name: str
    key: str  # of its files
    style: str
    drive: SimulatedDrive
    lidar: Lidar
    true_every: int  # scans, from where one looks for the truth
    every: tuple[int, ...] = ()  # each n-th scan that is used; empty: those of the paper


def _worlds(seed: int) -> tuple[_World, ...]:
    lidar = Lidar(elevation_max_deg=5.0)
    street = street_drive(seed, 60, 1.0, 60.0, lidar)
    noisy = Lidar(elevation_min_deg=-30.0, elevation_max_deg=30.0, noise_m=0.05)
    court = quad_walk(seed, 180, noisy)
    noisier = replace(noisy, noise_m=0.2)
    noisier_court = quad_walk(seed, 180, noisier)
    maicity, college, with_noise = WORLDS
    like_street = _World("A street like MaiCity's", maicity, maicity, street, lidar, 2)
    like_college = _World("A court like the Newer College's", college, college, court, noisy, 6)
    return (
        like_street,
        like_college,
        replace(
            like_college,
            name="The court with noise of 20 cm",
            key=with_noise,
            drive=noisier_court,
            lidar=noisier,
            every=(3, 9, 18),
        ),
    )


def main() -> None:
    """Write the page and its pictures."""
    parser = argparse.ArgumentParser(prog="python -m bench.paper", description=__doc__)
    parser.add_argument("--seed", type=int, default=11, help="of all worlds")
    options = parser.parse_args()
    parts = [(Path(__file__).with_name("intro.md")).read_text()]
    parts.append(f"Measured with Python {platform.python_version()} on {os.cpu_count()} cores.\n")
    with tempfile.TemporaryDirectory(prefix="triquad-paper-") as temporary:
        for world in _worlds(options.seed):
            folder = Path(temporary) / world.key
            report = folder.with_name(f"{world.key}-report")
            truth = folder.with_suffix(".ply")
            _write(world, folder, truth)
            words = ["paper", str(folder), str(report), "--reference", str(truth)]
            words += ["--style", world.style, "--as-published", "--name", world.name]
            words += ["--spacing", str(_SPACING_M)]
            if world.every:
                words += ["--every", *map(str, world.every)]
            if evaluate(words) != 0:
                raise SystemExit(f"{world.name}: the experiments ended with an error")
            page = (report / "report.md").read_text()
            for name in PICTURES:
                target = f"paper-{world.key}-{name}"
                picture = Image.open(report / name).convert("RGB").quantize(_COLOURS)
                picture.save(_DOCS / "images" / target, optimize=True)
                page = page.replace(f"({name})", f"(images/{target})")
            parts.append(page)
    (_DOCS / "paper.md").write_text("\n".join(parts))


def _write(world: _World, folder: Path, truth: Path) -> None:
    """Write a world's scans and poses as KITTI's, and its true surface as points."""
    drive = world.drive
    write_recording(folder, drive, drive.poses, world.name)
    low, high = drive.scene.bounds
    sensor = replace(world.lidar, beams=_TRUE_BEAMS, columns=_TRUE_COLUMNS, noise_m=0.0)
    seen = SimulatedDrive(drive.scene, sensor, drive.poses[:: world.true_every])
    hits = (scan.true_hits for scan in seen)
    points = merged(
        (some[((some >= low) & (some <= high)).all(axis=1)] for some in hits), _SPACING_M
    )
    Mesh(points, np.zeros((0, 3), np.int32), None).save(truth)


if __name__ == "__main__":
    main()
