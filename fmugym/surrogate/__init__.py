"""Surrogates: what an FMU has done, as a program of expressions that steps in its place."""
