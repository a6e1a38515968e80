"""Point-cloud files: PLY, PCD, NumPy and text."""
