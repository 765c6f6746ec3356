"""``python -m fmugym`` and the program ``fmugym``: the command line of ``fmugym.tools.cli``."""

from __future__ import annotations

import sys

__all__ = ["main"]

_INTERRUPTED = 130


def main() -> int:
    """Run the command line; Ctrl-C ends it quietly also while its modules are being loaded.

    Returns:
        The exit code.
    """
    try:
        from fmugym.tools import cli
    except KeyboardInterrupt:
        return _INTERRUPTED
    return cli.main()


if __name__ == "__main__":
    sys.exit(main())
