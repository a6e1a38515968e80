"""Completion of the side that the camera did not see: silhouettes, symmetry, axes, ellipsoids,
vessels. Not public.
"""
