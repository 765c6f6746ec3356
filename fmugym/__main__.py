"""``python -m fmugym``: the command line of ``fmugym.cli``."""

import sys

from fmugym.cli import main

if __name__ == "__main__":
    sys.exit(main())
