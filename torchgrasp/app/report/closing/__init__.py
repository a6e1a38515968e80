"""The film strip of a closing: stills of its moments above forces, slip and motion over time. Not public."""
