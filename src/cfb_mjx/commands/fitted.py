"""What every command that fits a model does alike: what it may be judged on, and what the model says of its origin."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path

from cfb_mjx import __version__
from cfb_mjx.errors import CfbError


def require_apart(fit: Sequence[Path], held_out: Sequence[Path]) -> None:
    """Refuse a log that is to be fitted and judged on.

    Raises:
        CfbError: a file is on both sides.
    """
    both = {path.resolve() for path in fit} & {path.resolve() for path in held_out}
    if both:
        names = ", ".join(sorted(path.name for path in both))
        raise CfbError(f"{names}: given to fit and as --held-out; nothing may be judged on what it was fitted to.")


def provenance(words: Sequence[str], base: str, hashes_name: str, paths: Sequence[Path], **more) -> dict:
    """Where a fitted model comes from: command line without folders, hashes of the fitted files, versions.

    Args:
        words: of the command line, without ``cfb``: ``["fit", *self.words()]``.
        base: name of the model started from.
        hashes_name: what the hashes are called.
        paths: fitted files.
        **more: further entries.
    """
    from cfb_mjx.runtime import environment

    return {
        "command": shlex.join(["cfb", *(Path(word).name if "/" in word else word for word in words)]),
        "base_model": base,
        hashes_name: {path.name: sha256(path.read_bytes()).hexdigest() for path in paths},
        **more,
        "cfb_mjx": __version__,
        "environment": environment(),
    }
