"""The surface of a map as triangles, by marching cubes, tile by tile."""
