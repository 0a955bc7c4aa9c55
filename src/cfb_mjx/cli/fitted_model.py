"""What every command that writes a fitted model does alike: where it may go, and what it says of its origin."""

from __future__ import annotations

import shlex
import sys
from hashlib import sha256
from pathlib import Path

from cfb_mjx import __version__
from cfb_mjx.errors import CfbError
from cfb_mjx.runtime import environment


def require_model_path(output: Path) -> None:
    """Refuse an output that no command would read back as a model.

    Raises:
        CfbError: it does not end in .yaml.
    """
    if output.suffix not in (".yaml", ".yml"):
        raise CfbError(f"{output}: the output is a model and must end in .yaml.")


def require_apart(fit: list[Path], held_out: list[Path]) -> None:
    """Refuse a log that is to be fitted and judged on.

    Raises:
        CfbError: a file is on both sides.
    """
    both = {path.resolve() for path in fit} & {path.resolve() for path in held_out}
    if both:
        names = ", ".join(sorted(path.name for path in both))
        raise CfbError(f"{names}: given to fit and as --held-out; nothing may be judged on what it was fitted to.")


def provenance(
    command: str, base: str, hashes_name: str, paths: list[Path], arguments: list[str] | None = None, **more
) -> dict:
    """Command line without folders, model started from, hashes of the fitted files, versions; and ``more``.

    ``arguments`` are those that would do the same, where another command does it.
    """
    given = sys.argv[2:] if arguments is None else arguments
    return {
        "command": shlex.join(["cfb", command, *(Path(a).name if "/" in a else a for a in given)]),
        "base_model": base,
        hashes_name: {path.name: sha256(path.read_bytes()).hexdigest() for path in paths},
        **more,
        "cfb_mjx": __version__,
        "environment": environment(),
    }
