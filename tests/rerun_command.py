"""rerun's own command, as a judge of what the library writes for it."""

import subprocess
import sys
from pathlib import Path


def rerun(*arguments: object, home: Path) -> str:
    """Run it; what it printed.

    Args:
        arguments: of the command.
        home: a home folder of its own: no settings are read or written and nothing is reported anywhere.
    """
    done = subprocess.run(
        [sys.executable, "-m", "rerun", *map(str, arguments)],
        capture_output=True,
        text=True,
        env={"HOME": str(home), "PATH": "/usr/bin:/bin", "RUST_LOG": "warn"},
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout
