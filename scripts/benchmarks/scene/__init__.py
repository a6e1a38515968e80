"""Benches of scenes of things on a table, seen in depth images, each with a target."""
