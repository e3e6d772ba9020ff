"""Scenes: triangles with materials and lights, from a mesh file or generated."""
