"""What the camera saw: reading, checking, normals, depth images, a virtual camera."""
