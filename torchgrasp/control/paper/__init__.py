"""The paper's control law and baselines, learned stability and object-level impedance. Not public."""
