"""Geometry: frames, planes, meshes, distance fields, linear algebra and least squares. Not public."""
