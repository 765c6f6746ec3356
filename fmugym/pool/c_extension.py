"""C extension: whether it can be imported, its installation, and its errors."""

from __future__ import annotations

import functools

from fmugym.errors import ConfigError

__all__ = [
    "has_native_pool",
    "needs_engine",
    "require_engine",
    "require_refusal",
]


@functools.cache
def has_native_pool() -> bool:
    """Whether the C extension was built when this package was installed."""
    try:
        import fmugym._native  # noqa: F401  (can it be imported?)
    except ImportError:
        return False
    return True


def needs_engine(doing: str) -> str:
    """Say in one line that something takes the C extension, with the cure if it is missing.

    Args:
        doing: What it is, the subject of the sentence.
    """
    if has_native_pool():
        return f"{doing} needs the C extension (backend='native')"
    return (
        f"{doing} needs the C extension of fmugym, which was not built because Python's headers "
        "were missing. Install them (on Debian: apt install python3-dev), and fmugym again"
    )


def require_engine(doing: str) -> None:
    """Refuse a feature of the C extension where that was not built.

    Args:
        doing: What it is, as for ``needs_engine``.

    Raises:
        ConfigError: If there is no C extension.
    """
    if not has_native_pool():
        raise ConfigError(needs_engine(doing))


def require_refusal(error: Exception) -> None:
    """Raise an error again unless the C code has refused the arguments of a call.

    A refused call may be repeated with other arguments. Errors of the receiver of messages and of
    signal handlers come after the work was done. They have passed Python functions; those of the C
    code have not.

    Args:
        error: What a call of the C code has raised, in the function that made the call.
    """
    trace = error.__traceback__
    if trace is not None and trace.tb_next is not None:
        raise error
