"""Write results atomically, so that a failure never destroys an earlier result, and find shipped files."""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import secrets
import stat
import tempfile
from collections.abc import Iterator, Mapping
from contextvars import ContextVar
from hashlib import sha256
from pathlib import Path
from typing import Literal, NamedTuple

from cfb_mjx import __version__
from cfb_mjx.errors import CfbError
from cfb_mjx.interrupts import held_back

try:
    import fcntl
except ImportError:  # Windows: temporary files of killed processes remain.
    fcntl = None

_TEMPORARY = re.compile(r"\..+\.[0-9a-f]{8}\.cfb\.tmp(\.[^.]+)?")


class _Written(NamedTuple):
    """A temporary file that has not been renamed to its final name."""

    temporary: Path
    lock: int
    """Handle with a lock; while it is held, the writer is alive."""

    def forget(self) -> None:
        """Delete the temporary file if it still exists."""
        with contextlib.suppress(OSError):
            self.temporary.unlink()
        os.close(self.lock)


_group: ContextVar[dict[Path, _Written | None] | None] = ContextVar("files that land together", default=None)
"""Temporary files by their final path; None: the file at that path is to be deleted."""


@contextlib.contextmanager
def replacing(path: str | os.PathLike) -> Iterator[Path]:
    """Yield a temporary path in the folder of ``path``; rename it to ``path`` if the block succeeds, else delete it.

    The rename is atomic: after a crash, a full disk or Ctrl-C there is the old file or the complete new one. Within
    `together`, the rename happens with those of the other files. The mode of an earlier file is kept. Temporary files
    of killed processes in the folder are deleted.

    Raises:
        CfbError: the folder is missing or the file cannot be written (full disk, no permission).
    """
    path = Path(path)
    require_folder(path)
    if path.is_dir():
        raise CfbError(f"{path}: this is a folder; give the name of a file to write.")
    written, group = None, _group.get()
    try:
        _clear(path.parent)
        written = _begin(path)
        yield written.temporary
        with open(written.temporary, "rb") as file:
            os.fsync(file.fileno())
        written.temporary.chmod(_mode(path))
        if group is None:
            written.temporary.replace(path)
        else:
            _put(group, path, written)
            written = None
    except OSError as error:
        raise _unwritten(path, error) from error
    finally:
        if written is not None:
            written.forget()


@contextlib.contextmanager
def together() -> Iterator[None]:
    """Rename all files that are written in this block at its end, or none of them if it fails.

    A folder therefore never has new files together with old ones. If the process is killed during the renames, some
    files are missing. Nested blocks are renamed with the outermost one.

    Raises:
        CfbError: a file cannot be renamed; all files are as they were.
    """
    if _group.get() is not None:
        yield
        return
    group: dict[Path, _Written | None] = {}
    token = _group.set(group)
    try:
        yield
        _land(group)
    finally:
        _group.reset(token)
        for written in group.values():
            if written is not None:
                written.forget()


@contextlib.contextmanager
def scratch(prefix: str = "cfb-") -> Iterator[str]:
    """Yield a temporary folder that exists during the block; its files are renamed immediately, also in `together`."""
    token = _group.set(None)
    try:
        with tempfile.TemporaryDirectory(prefix=prefix) as folder:
            yield folder
    finally:
        _group.reset(token)


def remove(path: str | os.PathLike) -> None:
    """Delete a file if it exists; within `together`, when the other files are renamed."""
    group = _group.get()
    if group is None:
        Path(path).unlink(missing_ok=True)
    else:
        _put(group, Path(path), None)


def _put(group: dict[Path, _Written | None], path: Path, written: _Written | None) -> None:
    before = group.pop(path.absolute(), None)
    if before is not None:
        before.forget()
    group[path.absolute()] = written


def _land(group: dict[Path, _Written | None]) -> None:
    new = {path: written.temporary for path, written in group.items() if written is not None}
    if not new:
        for path in group:
            path.unlink(missing_ok=True)
        return
    first, aside = next(iter(new)), {}
    with held_back():
        try:
            for path in group:
                if path != first and path.exists():
                    old = _name(path)
                    path.rename(old)
                    aside[path] = old
            new[first].replace(first)
        except OSError as error:
            for path, old in aside.items():
                old.replace(path)
            raise _unwritten(first, error) from error
        # From here on nothing can be undone, and no old file blocks a rename.
        for path, temporary in new.items():
            if path != first:
                temporary.replace(path)
        for old in aside.values():
            with contextlib.suppress(OSError):
                old.unlink()


def _name(path: Path) -> Path:
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}.cfb.tmp{path.suffix}")


def _begin(path: Path) -> _Written:
    """Create a temporary file that only the user can read until it is renamed."""
    while True:
        temporary = _name(path)
        lock = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
        # On a file system without locks, temporary files of dead processes are not recognised.
        with contextlib.suppress(OSError):
            if fcntl is not None:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if temporary.exists():
            return _Written(temporary, lock)
        os.close(lock)  # Another process deleted it as that of a dead process before it was locked.


def _clear(folder: Path) -> None:
    """Delete the temporary files of dead processes, whose locks nobody holds."""
    if fcntl is None:
        return
    # Suppress: a folder may be writable but not readable, and a lock may be held.
    with contextlib.suppress(OSError):
        left = [entry for entry in os.scandir(folder) if _TEMPORARY.fullmatch(entry.name)]
        for entry in left:
            with contextlib.suppress(OSError), open(entry.path, "rb") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                os.unlink(entry.path)


def _mode(path: Path) -> int:
    """Return the mode of the earlier file, or the one that open() would give a new file."""
    with contextlib.suppress(FileNotFoundError):
        return stat.S_IMODE(path.stat().st_mode)
    umask = os.umask(0)
    os.umask(umask)
    return 0o666 & ~umask


def _unwritten(path: Path, error: OSError) -> CfbError:
    return CfbError(
        f"{path}: could not be written ({error.strerror or error}); free some space or choose another place. "
        "Earlier files are unchanged."
    )


def require_folder(*paths: str | os.PathLike | None) -> None:
    """Refuse outputs whose folder does not exist, before any work is done; None is an output that is not requested.

    Raises:
        CfbError: a folder does not exist; the message names the first such output.
    """
    for path in paths:
        if path is not None and not Path(path).parent.is_dir():
            raise CfbError(f"{path}: the folder {Path(path).parent} does not exist; create it first.")


FIGURES = (".svg", ".png", ".pdf")
"""Formats that figures are written in."""
VectorFormat = Literal["pdf", "svg"]


def require_ending(path: str | os.PathLike, endings: tuple[str, ...], demand: str) -> Path:
    """Return the path if it ends in one of ``endings``, ignoring case.

    Raises:
        CfbError: it has another ending; the message is ``demand``.
    """
    path = Path(path)
    if path.suffix.lower() not in endings:
        raise CfbError(f"{path}: {demand}.")
    return path


def output_folder(path: str | os.PathLike) -> Path:
    """Create the output folder of a command, with its parents.

    Raises:
        CfbError: there is a file of that name, or the folder cannot be created.
    """
    path = Path(path)
    require_no_file(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CfbError(
            f"{path}: this folder cannot be created ({error.strerror or error}); choose another place."
        ) from None
    return path


def require_no_file(path: str | os.PathLike) -> None:
    """Refuse an output folder whose path is or contains a file, before any work is done.

    Raises:
        CfbError: it does; the message names the file.
    """
    for place in (Path(path), *Path(path).parents):
        if place.exists():
            if not place.is_dir():
                raise CfbError(f"{place}: this is a file; give the name of a folder for the results.")
            return


def read_bytes(path: str | os.PathLike, count: int = -1) -> bytes:
    """Read the first ``count`` bytes of a file, by default all; within `together`, of the version written there.

    Raises:
        CfbError: the file is missing or cannot be read.
    """
    newest = (_group.get() or {}).get(Path(path).absolute())
    try:
        with open(path if newest is None else newest.temporary, "rb") as file:
            return file.read(count)
    except FileNotFoundError:
        raise CfbError(f"{path}: there is no such file; check the path.") from None
    except OSError as error:
        raise CfbError(
            f"{path}: cannot be read ({error.strerror or error}); check the path and its permissions."
        ) from None


def write_text(path: str | os.PathLike, text: str) -> None:
    """Write a text file atomically (see `replacing`)."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_texts(folder: str | os.PathLike, texts: Mapping[str, str]) -> None:
    """Write several text files: all of them, or none if one cannot be written."""
    with together():
        for name, text in texts.items():
            write_text(Path(folder) / name, text)


def write_json(path: str | os.PathLike, value: object) -> None:
    """Write ``value`` as JSON atomically; NaN and infinities, which JSON does not have, become null."""
    write_text(path, json.dumps(plain(value), indent=1) + "\n")


def plain(value):
    """Convert to JSON values: arrays become lists; NaN and infinities, which JSON does not have, become null."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def code_identity() -> str:
    """Return version and hash of the library's source; only the same code may resume unfinished work."""
    package = Path(__file__).resolve().parent
    digest = sha256()
    for path in sorted(package.rglob("*.py")):
        digest.update(path.relative_to(package).as_posix().encode() + sha256(path.read_bytes()).digest())
    return f"{__version__} {digest.hexdigest()[:16]}"


def shipped(*parts: str) -> Path:
    """Return the path of a file that is part of the library, installed or in a checkout.

    Args:
        parts: parts of the path, for instance ``"configs", "loop.yaml"``.

    Raises:
        CfbError: the installation is incomplete.
    """
    package = Path(__file__).resolve().parent
    for root in (package / "_data", package.parents[1]):
        path = root.joinpath(*parts)
        if path.exists():
            return path
    raise CfbError(f"{'/'.join(parts)} is missing from this installation of cfb_mjx; reinstall it.")
