"""Rigs in the place of FMU instances, and the clocks that pace them."""
