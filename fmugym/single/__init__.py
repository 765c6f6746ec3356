"""Compiled steps of single environments: the hooks run as programs inside the native pool."""

from fmugym.single.player import Player

__all__ = ["Player"]
