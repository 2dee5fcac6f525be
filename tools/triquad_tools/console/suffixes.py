"""The kinds of files that commands write, by how their names end."""

MAP_SUFFIX, PICTURE_SUFFIX = ".triquad", ".png"
MESH_SUFFIXES = (".ply", ".glb", ".obj", ".stl")
SUFFIXES = (MAP_SUFFIX, *MESH_SUFFIXES, PICTURE_SUFFIX)
