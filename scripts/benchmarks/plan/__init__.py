"""The contact planner, beside its bars."""
