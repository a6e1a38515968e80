"""What makes the files that are shipped; `scripts/train.py` calls them."""
