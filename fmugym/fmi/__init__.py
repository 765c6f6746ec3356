"""What the versions of FMI have in common: statuses, messages, and the chain rule of systems."""

from fmugym.fmi.status import Status

__all__ = ["Status"]
