"""Inverse kinematics: hand configurations that reach planned contacts."""
