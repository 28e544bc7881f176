"""`python -m vio` is the command `vio`."""

import sys

from vio.cli import main

sys.exit(main())
