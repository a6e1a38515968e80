"""Benches of how long a plan takes, each with a target."""
