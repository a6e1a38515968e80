"""What scripts/bench.py measures: a folder for each subject, with a file for each bench or two."""
