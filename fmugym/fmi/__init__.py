"""Common parts of the FMI versions: statuses, messages, and the chain rule of systems."""

from fmugym.fmi.status import Status

__all__ = ["Status"]
