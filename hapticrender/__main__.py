"""``python -m hapticrender`` is the command line."""

import sys

from hapticrender.cli import main

sys.exit(main())
