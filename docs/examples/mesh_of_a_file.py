"""Save the surface of a map file as a mesh, without a server."""

import argparse
from pathlib import Path

import triquad_client


def main() -> None:
    """All that rays have seen, or what of it lies in a box."""
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("file", type=Path, help="map file, or a server's store")
    add("out", type=Path, help="its name ends in .ply, .glb, .obj or .stl")
    add("--cell", type=float, default=0.1, help="metres")
    add("--low", type=float, nargs=3, default=(-float("inf"),) * 3, metavar="M", help="least x y z")
    add("--high", type=float, nargs=3, default=(float("inf"),) * 3, metavar="M", help="largest")
    options = parser.parse_args()
    with triquad_client.open_map(options.file) as offline:
        mesh = offline.mesh((options.low, options.high), cell_m=options.cell)
    mesh.save(options.out)
    print(f"{len(mesh.vertices):,} vertices, {len(mesh.faces):,} faces, epoch {mesh.epoch}")


if __name__ == "__main__":
    main()
