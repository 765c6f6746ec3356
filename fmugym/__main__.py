"""``python -m fmugym`` and the program ``fmugym``: ``fmugym.cli.command_line``."""

from __future__ import annotations

import sys

from fmugym.cli.signals import end_as_after_ctrl_c, exit_code

__all__ = ["main"]


def main() -> int:
    """Run the command line; Ctrl-C ends it quietly also while its modules are being loaded.

    Returns:
        The exit code.
    """
    try:
        end_as_after_ctrl_c()
        sys.path.append("")  # module:Class may be in the working directory
        from fmugym.cli import command_line

        return command_line.run_command_line()
    except KeyboardInterrupt as error:
        return exit_code(error)


if __name__ == "__main__":
    sys.exit(main())
