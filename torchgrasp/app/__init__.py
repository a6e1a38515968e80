"""Applications of the library: command line, reports, drafts of hands. Not public."""
