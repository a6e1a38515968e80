"""Many calls in one process, and one call on much."""
