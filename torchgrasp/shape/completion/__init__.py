"""The side that the camera did not see: silhouettes, symmetry, axes of revolution, ellipsoids, vessels."""
