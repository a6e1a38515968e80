"""Figures of README and guides that `scripts/reproduce.py claims` runs again; `table.py` runs them."""
