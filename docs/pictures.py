"""Makes the pictures of the documentation anew: ``make pictures``, or one by its name.

Each is what a command draws, made narrower and of few colours, as it is shown beside text. Maps
come from ``demo-out``, which ``make demo`` leaves and which is made where it is missing.
"""

import runpy
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from PIL import Image
from triquad_client import Status, open_map
from triquad_format.records.arrays import Bytes
from triquad_server import serve
from triquad_server.settings.loading import load_settings
from triquad_tools.plots.colours import DISTANCES, FREE, UNKNOWN
from triquad_tools.plots.picture import BACKGROUND, HEIGHT, WIDTH, draw_faces, view_along
from triquad_tools.simulation.lidar import Lidar, SimulatedDrive
from triquad_tools.simulation.solids import Solid, box
from triquad_tools.simulation.street import street_drive

from bench.parts.poses import drifting
from bench.scenes.block import block_drive

IMAGES = Path(__file__).with_name("images")
ROOT = IMAGES.parents[1]

_WIDTH, _COLOURS = 1200, 256
_CELL_M, _MAX_DISTANCE_M = 0.1, 3.0  # of the slice
_DEMO, _STREET, _SCANS = "demo-out", 1, 25
_KINDS = {Status.FREE: FREE, Status.SURFACE: "#a3341f", Status.UNKNOWN: UNKNOWN}
_AROUND_M = ((-1.0, -8.0, -1.0), (24.0, 8.0, 4.0))
_BLOCK, _SIDE_M, _AROUND_SCANS = 36, 60.0, 254  # its streets are 60 m long
_BLOCK_M = ((-45.0, -45.0, 1.0), (45.0, 45.0, 1.0))
_BOX_HALF_M = (0.6, 0.5, 0.9)
_MONDAY = [(6.0, 2.0), (11.0, 1.2), (15.0, 2.5)]  # boxes on the road, x and y
_TUESDAY = [(7.5, 2.0), (15.0, 2.5), (19.0, 1.0)]  # one moved, one gone, one more


def street(out: Path) -> None:
    """The README's: what the demonstration draws."""
    out.write_bytes((ROOT / _DEMO / "street.png").read_bytes())


def map_from_above(out: Path) -> None:
    """A picture of a map."""
    _run("triquad-pack", f"{_DEMO}/map.triquad", out, "--force")


def height_slice(out: Path) -> None:
    """Distance and status at one height."""
    with open_map(ROOT / _DEMO / "map.triquad") as opened:
        found = opened.query_grid(((0, -12, 1), (40, 12, 1)), _CELL_M, _MAX_DISTANCE_M)
    distance_m, status = found.distance_m[:, :, 0].T, found.status[:, :, 0].T
    figure = Figure((12, 11), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    extent, known = (0, 40, -12, 12), np.where(status == Status.UNKNOWN, np.nan, distance_m)
    upper.set_facecolor(UNKNOWN)
    shown = upper.imshow(known, DISTANCES, vmin=0, vmax=3, extent=extent, origin="lower")
    figure.colorbar(shown, ax=[upper, lower], label="m to the nearest surface, 3 or more")
    _draw_status(lower, status, extent)
    patches = [Patch(facecolor=_KINDS[kind], edgecolor="k", label=kind.name) for kind in _KINDS]
    lower.legend(handles=patches, loc="upper left", bbox_to_anchor=(0, -0.12), ncols=3)
    lower.set(xlabel="x in m", ylabel="y in m")
    upper.set_ylabel("y in m")
    figure.savefig(out)


def difference(out: Path) -> None:
    """What changed between two drives down a street with boxes on it."""
    with tempfile.TemporaryDirectory() as folder:
        files = {"monday.triquad": _MONDAY, "tuesday.triquad": _TUESDAY}
        for name, places in files.items():
            boxes = [box((x, y, _BOX_HALF_M[2]), _BOX_HALF_M) for x, y in places]
            _map_of(_with_boxes(boxes), Path(folder) / name)
        _run("triquad-inspect", *files, "--diff", "--plot", out, folder=Path(folder))


def corrected(out: Path) -> None:
    """A map around a block made with poses that drift, and after these were corrected."""
    drive = block_drive(_BLOCK, _SIDE_M, _AROUND_SCANS, 1.0, Lidar(columns=1024))
    stamps_s = np.arange(1.0, 1.0 + _AROUND_SCANS)
    settings = load_settings(assignments=["store.log_max_bytes=1000000000"])
    with (
        tempfile.TemporaryDirectory() as store,
        serve(map="block", store=store, settings=settings) as server,
        server.client() as client,
    ):
        for scan, pose, stamp_s in zip(drive, drifting(drive.poses), stamps_s, strict=True):
            client.publish_scan(scan.points, pose, stamp_s, source="lidar")
            client.flush()
        shown = {"as published": client.query_grid(_BLOCK_M, _CELL_M)}
        client.correct_poses("lidar", stamps_s, drive.poses)
        shown["corrected"] = client.query_grid(_BLOCK_M, _CELL_M)
    figure = Figure((12, 6.4), layout="constrained")
    (x, y, _), (far_x, far_y, _) = _BLOCK_M
    for axes, (title, found) in zip(figure.subplots(1, 2, sharey=True), shown.items(), strict=True):
        _draw_status(axes, found.status[:, :, 0].T, (x, far_x, y, far_y))
        axes.set(title=title, xlabel="x in m")
    figure.savefig(out)


def preview(out: Path) -> None:
    """What MCAP tools show of a map file."""
    example = runpy.run_path(str(ROOT / "docs" / "examples" / "map_file_as_mcap.py"))
    with (ROOT / _DEMO / "map.triquad").open("rb") as file:
        scene = example["preview"](make_reader(file, decoder_factories=[DecoderFactory()]))
    shown: Any = trimesh.util.concatenate(list(scene.geometry.values()))
    colours = shown.visual.vertex_colors[:, :3] / 255.0
    figure = Figure((WIDTH / 100, HEIGHT / 100), 100, facecolor=BACKGROUND)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    view = view_along(shown.vertices, shown.vertices[shown.faces])
    draw_faces(axes, view, shown.vertices, shown.faces, colours)
    figure.savefig(out)


def tradeoffs(out: Path) -> None:
    """Accuracy by time, bytes and scan spacing; this one takes ten minutes."""
    _run("python", "-m", "bench.studies.tradeoffs", out)


PICTURES: dict[str, Callable[[Path], None]] = {
    "street.png": street,
    "map.png": map_from_above,
    "slice.png": height_slice,
    "difference.png": difference,
    "corrected.png": corrected,
    "preview.png": preview,
    "tradeoffs.png": tradeoffs,
}
"""What makes each: it is given the path to write to."""


def _draw_status(axes: Axes, status: Bytes, extent: tuple[float, float, float, float]) -> None:
    """Draw the status [Y, X] of the cells of a plane."""
    colours = ListedColormap([_KINDS[kind] for kind in sorted(_KINDS)])
    axes.imshow(status, colours, extent=extent, origin="lower", interpolation="none")


def _with_boxes(boxes: list[Solid]) -> SimulatedDrive:
    made = street_drive(_STREET, _SCANS)
    return replace(made, scene=replace(made.scene, solids=(*made.scene.solids, *boxes)))


def _map_of(drive: SimulatedDrive, path: Path) -> None:
    with serve(map="street") as server, server.client() as client:
        for scan in drive:
            client.publish_scan(scan.points, scan.world_from_sensor)
            client.flush()
        client.settle()
        client.sync(_AROUND_M, path)


def _run(command: str, *arguments: object, folder: Path = ROOT) -> None:
    """Run a command of this environment, which says itself what went wrong."""
    program = Path(sys.executable).with_name(command)
    subprocess.run([program, *map(str, arguments)], cwd=folder, check=True, stdout=sys.stderr)


def for_pages(picture: Image.Image) -> Image.Image:
    """The picture no wider than a page, and of few colours: a small file."""
    shown = picture.convert("RGB")
    if shown.width > _WIDTH:
        height = round(shown.height * _WIDTH / shown.width)
        shown = shown.resize((_WIDTH, height), Image.Resampling.LANCZOS)
    # So that also rare colours, as those of legends, remain what they are.
    coverage = Image.Quantize.MAXCOVERAGE
    return shown.quantize(_COLOURS, coverage, kmeans=4, dither=Image.Dither.NONE)


def main(names: list[str]) -> None:
    """Make the pictures of these names, or all of them."""
    unknown = sorted(set(names) - set(PICTURES))
    if unknown:
        sys.exit(f"no picture is called {', '.join(unknown)}; there are {', '.join(PICTURES)}")
    if not (ROOT / _DEMO / "map.triquad").is_file():
        _run("triquad-demo", "--out", _DEMO)
    with tempfile.TemporaryDirectory() as folder:
        for name in names or PICTURES:
            made = Path(folder) / name
            PICTURES[name](made)
            with Image.open(made) as picture:
                for_pages(picture).save(IMAGES / name, optimize=True)


if __name__ == "__main__":
    main(sys.argv[1:])
