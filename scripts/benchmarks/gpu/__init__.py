"""Benches of plans of many clouds at once on a GPU, and of what such plans ask of it."""
