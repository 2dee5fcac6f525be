"""List what a map file holds and save its preview as a GLB, by MCAP's own libraries alone."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from mcap.reader import McapReader, make_reader
from mcap_protobuf.decoder import DecoderFactory

Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # glTF has y up


def main() -> None:
    """The list on standard output; one node of the GLB for each region of the map."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path, help="map file")
    parser.add_argument("out", type=Path, help="its name ends in .glb")
    options = parser.parse_args()
    with options.file.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        list_topics(reader)
        scene = preview(reader)
    scene.export(options.out)


def list_topics(reader: McapReader) -> None:
    """Print topics, how many messages they have, and how these are encoded."""
    summary = reader.get_summary()
    if summary is None or summary.statistics is None:
        raise SystemExit("the file has no summary: it is not complete")
    for channel in summary.channels.values():
        count = summary.statistics.channel_message_counts.get(channel.id, 0)
        schema = summary.schemas.get(channel.schema_id)
        encoding = channel.message_encoding if schema is None else schema.name
        print(f"{count:5} {channel.topic:20} {encoding}")


def preview(reader: McapReader) -> trimesh.Scene:
    """The surfaces that viewers show, in colours; prints what the file says of them."""
    scene = trimesh.Scene()
    for *_, update in reader.iter_decoded_messages(topics=["/preview/mesh"]):
        for entity in update.entities:
            mesh = mesh_of(entity.triangles[0])
            if len(mesh.faces):  # a region of which nothing was seen has none
                scene.add_geometry(mesh, node_name=entity.id, transform=Y_UP)
            words = [f"{pair.key}: {pair.value}" for pair in entity.metadata]
            print(f"{entity.id}: {len(mesh.faces):,} faces", *words, sep="\n  ")
    return scene


def mesh_of(triangles: Any) -> trimesh.Trimesh:
    """The mesh of a ``foxglove.TriangleListPrimitive``, metres, map frame."""
    colours = np.array([(c.r, c.g, c.b, c.a) for c in triangles.colors]).reshape(-1, 4)
    return trimesh.Trimesh(
        np.array([(p.x, p.y, p.z) for p in triangles.points]).reshape(-1, 3),
        np.array(triangles.indices).reshape(-1, 3),
        vertex_colors=np.rint(255 * colours).astype(np.uint8),
        process=False,
    )


if __name__ == "__main__":
    main()
