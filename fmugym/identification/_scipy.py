"""Late import of SciPy, so that the rest of the package works without it."""

from __future__ import annotations

import importlib
from typing import Any

__all__ = ["scipy_module"]


def scipy_module(name: str) -> Any:
    """Import a module of SciPy.

    Raises:
        ImportError: If SciPy is not installed; the text names the extra that installs it.
    """
    try:
        return importlib.import_module(f"scipy.{name}")
    except ImportError:
        raise ImportError(
            'fmugym.identification needs SciPy: pip install "fmugym-toolbox[identification]"'
        ) from None
