"""Closing and holding: the controller of a real or a simulated hand."""
