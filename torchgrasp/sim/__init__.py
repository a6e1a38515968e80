"""The simulated world that a controller acts in: SAPIEN or MuJoCo."""
