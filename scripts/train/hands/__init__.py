"""The shipped hands that are written from tables: numbers of each hand, their files, mirror images."""
