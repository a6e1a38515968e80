"""The whole chain, from one view to a held object."""
