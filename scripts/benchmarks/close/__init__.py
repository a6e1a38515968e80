"""Benches of grasps that a simulated hand closes, lifts or pulls at, each with a target."""
