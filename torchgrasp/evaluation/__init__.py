"""Simulated trials: lifts, pulls, protocols and scores."""
