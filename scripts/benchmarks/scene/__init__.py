"""Scenes of things on a table, beside their bars."""
