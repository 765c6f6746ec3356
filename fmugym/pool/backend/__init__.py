"""Pools of rigs that stand in for an FMU, and the clocks that pace them."""
