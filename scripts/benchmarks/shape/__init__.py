"""The shape, beside its bars."""
