"""Pools whose instances run in supervised worker processes."""
