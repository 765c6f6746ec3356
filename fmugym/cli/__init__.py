"""Command line: its commands, overviews, skeletons and checks."""
