"""Tools around an FMU: the command line, overviews, skeletons, linear models."""
