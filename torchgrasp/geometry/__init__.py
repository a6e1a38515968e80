"""Geometry: frames, planes, meshes, distance fields, linear algebra, least squares. Not public."""
