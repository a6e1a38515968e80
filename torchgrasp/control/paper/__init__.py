"""Baselines: the paper's control law, position control, object-level impedance and learned grasp stability."""
