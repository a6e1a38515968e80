"""The simulated world in which a hand closes, in SAPIEN or MuJoCo, and files with which other simulators repeat it."""
