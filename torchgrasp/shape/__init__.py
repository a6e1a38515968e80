"""What the object may look like: a Gaussian process over signed distance and normals."""
