"""Environments: episodes of one FMU, or of N in ``vector``, with their config, spaces and hooks."""
