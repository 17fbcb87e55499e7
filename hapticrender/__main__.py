"""``python -m hapticrender`` is the command line."""

import sys

from hapticrender.cli import main

if __name__ == "__main__":
    sys.exit(main())
