"""What the paper compares with: its control law and baselines, learned stability and object-level impedance. Not public."""
