"""The film strip of a closing: stills of its moments above forces, slip and motion over time."""

from torchgrasp.report.closing.film import describe_film, draw_film

__all__ = ["describe_film", "draw_film"]
