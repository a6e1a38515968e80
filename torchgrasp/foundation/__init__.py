"""What all other folders build on, without robotics: errors, checks, processes, limits. Not public."""
