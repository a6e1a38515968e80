"""The tables and figures of the paper; `scripts/reproduce.py` calls them."""
