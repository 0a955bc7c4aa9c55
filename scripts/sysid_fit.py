"""Fit the model to flights: ``cfb fit`` as a script, to copy and change.

python scripts/sysid_fit.py LOG... -o model.yaml [--set mass=0.045] [--compare] [--figure fit.png]
"""

import sys

from cfb_mjx.cli import main

if __name__ == "__main__":
    sys.exit(main(["fit", *sys.argv[1:]]))
