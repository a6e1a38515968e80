"""Benches of the numbers that README publishes, all measured at one commit."""
