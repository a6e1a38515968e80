"""What all other folders build on, without robotics: errors, checks, jobs, limits. Not public."""
