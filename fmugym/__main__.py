"""``python -m fmugym``: the command line of ``fmugym.tools.cli``."""

import sys

from fmugym.tools.cli import main

if __name__ == "__main__":
    sys.exit(main())
