"""``python -m cfb_mjx.cli``."""

import sys

from cfb_mjx.cli import main

sys.exit(main())
