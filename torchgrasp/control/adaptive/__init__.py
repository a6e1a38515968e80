"""Adaptive control: impedance, learned stability, and a shape revised by touch."""
