"""Other planners beside ours: the same objects, one core, the same checks, the same trial."""
