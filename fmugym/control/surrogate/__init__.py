"""Surrogates: programs of expressions, fitted to episodes of an FMU, that step in its place."""
