"""Applications of the library: command line, reports, authoring of new hands. Not public."""
