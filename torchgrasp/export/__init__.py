"""Grasps and surfaces for other programs."""
