"""Writing results so that a failure never costs the user an earlier one, and finding shipped files."""

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
except ImportError:  # Windows: what a killed process leaves stays there.
    fcntl = None

_TEMPORARY = re.compile(r"\..+\.[0-9a-f]{8}\.cfb\.tmp(\.[^.]+)?")


class _Written(NamedTuple):
    """A file that is not in its place yet."""

    temporary: Path
    lock: int
    """An open handle: while it is held, the writer is alive."""

    def forget(self) -> None:
        """Delete it, unless it is in its place."""
        with contextlib.suppress(OSError):
            self.temporary.unlink()
        os.close(self.lock)


_group: ContextVar[dict[Path, _Written | None] | None] = ContextVar("files that land together", default=None)
"""By the path where each will be; None: what is there is to be gone."""


@contextlib.contextmanager
def replacing(path: str | os.PathLike) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; rename it to ``path`` if the block succeeds, delete it otherwise.

    The rename is atomic, so a reader (or a crash, a full disk, Ctrl-C) sees the old file or the whole new one; within
    `together` it comes with those of the other files. The mode of an earlier file is kept. What processes that were
    killed have left in the folder is deleted.

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
    """Let all files that are written in this block take their places at its end, or none of them if it fails.

    Whenever the process ends, a folder holds files of one run: none that is new beside one that is old. If it is killed
    within the moment in which names change, some are missing. Blocks within a block land with the outermost.

    Raises:
        CfbError: a file cannot be put in its place; all are as they were.
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
    """A folder of files that are used within the block and thrown away: they are there at once, also in `together`."""
    token = _group.set(None)
    try:
        with tempfile.TemporaryDirectory(prefix=prefix) as folder:
            yield folder
    finally:
        _group.reset(token)


def remove(path: str | os.PathLike) -> None:
    """Delete a file if it is there; within `together`, when the others take their places."""
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
        # From here on there is no way back, and nothing in the way.
        for path, temporary in new.items():
            if path != first:
                temporary.replace(path)
        for old in aside.values():
            with contextlib.suppress(OSError):
                old.unlink()


def _name(path: Path) -> Path:
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}.cfb.tmp{path.suffix}")


def _begin(path: Path) -> _Written:
    """A new temporary file, private until it is in place."""
    while True:
        temporary = _name(path)
        lock = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
        # A file system without locks does without what they are for.
        with contextlib.suppress(OSError):
            if fcntl is not None:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if temporary.exists():
            return _Written(temporary, lock)
        os.close(lock)  # Another process took it for a dead one's before it was locked.


def _clear(folder: Path) -> None:
    """Delete the temporary files of dead processes: nobody holds their locks."""
    if fcntl is None:
        return
    # A folder may be written and not listed, and a lock may be held.
    with contextlib.suppress(OSError):
        left = [entry for entry in os.scandir(folder) if _TEMPORARY.fullmatch(entry.name)]
        for entry in left:
            with contextlib.suppress(OSError), open(entry.path, "rb") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                os.unlink(entry.path)


def _mode(path: Path) -> int:
    """That of the earlier file, or what an ordinary open() would give a new one."""
    with contextlib.suppress(FileNotFoundError):
        return stat.S_IMODE(path.stat().st_mode)
    umask = os.umask(0)
    os.umask(umask)
    return 0o666 & ~umask


def _unwritten(path: Path, error: OSError) -> CfbError:
    return CfbError(
        f"{path}: could not be written ({error.strerror or error}); free some space or choose another place. "
        "Nothing that was there before has changed."
    )


def require_folder(*paths: str | os.PathLike | None) -> None:
    """Refuse, before any work is done, outputs (None: not asked for) whose folder does not exist.

    Raises:
        CfbError: names the first such output.
    """
    for path in paths:
        if path is not None and not Path(path).parent.is_dir():
            raise CfbError(f"{path}: the folder {Path(path).parent} does not exist; create it first.")


FIGURES = (".svg", ".png", ".pdf")
VectorFormat = Literal["pdf", "svg"]
"""Formats that figures are written in."""


def require_ending(path: str | os.PathLike, endings: tuple[str, ...], demand: str) -> Path:
    """The path, if it ends in one of ``endings``, in small or capital letters.

    Raises:
        CfbError: another ending; ``demand`` says which it must be.
    """
    path = Path(path)
    if path.suffix.lower() not in endings:
        raise CfbError(f"{path}: {demand}.")
    return path


def output_folder(path: str | os.PathLike) -> Path:
    """Make the folder a command writes its files into, with those above it.

    Raises:
        CfbError: a file is in the way, or the folder cannot be made.
    """
    path = Path(path)
    require_no_file(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CfbError(
            f"{path}: this folder cannot be made ({error.strerror or error}); choose another place."
        ) from None
    return path


def require_no_file(path: str | os.PathLike) -> None:
    """Refuse, before any work is done, a folder for results where a file is, or below one.

    Raises:
        CfbError: names the file.
    """
    for place in (Path(path), *Path(path).parents):
        if place.exists():
            if not place.is_dir():
                raise CfbError(f"{place}: this is a file; give the name of a folder for the results.")
            return


def read_bytes(path: str | os.PathLike, count: int = -1) -> bytes:
    """The first ``count`` bytes of a file, all of it by default; within `together`, of what was written there.

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
    """Write text files that belong together: all of them, or, when one cannot be written, none."""
    with together():
        for name, text in texts.items():
            write_text(Path(folder) / name, text)


def write_json(path: str | os.PathLike, value: object) -> None:
    """Write ``value`` as JSON atomically; NaN and infinities, which JSON lacks, become null."""
    write_text(path, json.dumps(plain(value), indent=1) + "\n")


def plain(value):
    """JSON terms only: arrays become lists; NaN and infinities, which JSON lacks, become null."""
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
    """Version of the library, and a hash of its source: what is half done is gone on with by the same code only."""
    package = Path(__file__).resolve().parent
    digest = sha256()
    for path in sorted(package.rglob("*.py")):
        digest.update(path.relative_to(package).as_posix().encode() + sha256(path.read_bytes()).digest())
    return f"{__version__} {digest.hexdigest()[:16]}"


def shipped(*parts: str) -> Path:
    """Path of a file shipped with the library (``assets/...`` or ``configs/...``), installed or from a checkout."""
    package = Path(__file__).resolve().parent
    for root in (package / "_data", package.parents[1]):
        path = root.joinpath(*parts)
        if path.exists():
            return path
    raise CfbError(f"{'/'.join(parts)} is missing from this installation of cfb_mjx; reinstall it.")
