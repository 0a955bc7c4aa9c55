"""Writing results so that a failure never costs the user an earlier one, and finding shipped files."""

from __future__ import annotations

import contextlib
import json
import math
import os
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

from cfb_mjx.errors import CfbError


@contextlib.contextmanager
def replacing(path: str | os.PathLike) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; rename it to ``path`` if the block succeeds, delete it otherwise.

    The rename is atomic, so a reader (or a crash, a full disk, Ctrl-C) sees the old file or the whole new one.

    Raises:
        CfbError: the folder is missing or the file cannot be written (full disk, no permission).
    """
    path = Path(path)
    require_folder(path)
    if path.is_dir():
        raise CfbError(f"{path}: this is a folder; give the name of a file to write.")
    temporary = None
    try:
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=f".tmp{path.suffix}", dir=path.parent)
        os.close(handle)
        temporary = Path(name)
        yield temporary
        with open(temporary, "rb") as written:
            os.fsync(written.fileno())
        # mkstemp makes the file private; give it the mode an ordinary open() would have given.
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        temporary.replace(path)
        temporary = None
    except OSError as error:
        raise CfbError(
            f"{path}: could not be written ({error.strerror or error}); free some space or choose another place. "
            "Nothing that was there before has changed."
        ) from error
    finally:
        if temporary is not None:
            with contextlib.suppress(OSError):
                temporary.unlink()


def require_folder(*paths: str | os.PathLike | None) -> None:
    """Refuse, before any work is done, outputs (None: not asked for) whose folder does not exist.

    Raises:
        CfbError: names the first such output.
    """
    for path in paths:
        if path is not None and not Path(path).parent.is_dir():
            raise CfbError(f"{path}: the folder {Path(path).parent} does not exist; create it first.")


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
    """The first ``count`` bytes of a file, all of it by default.

    Raises:
        CfbError: the file is missing or cannot be read.
    """
    try:
        with open(path, "rb") as file:
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
    with contextlib.ExitStack() as stack:
        for name, text in texts.items():
            stack.enter_context(replacing(Path(folder) / name)).write_text(text, encoding="utf-8")


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


def shipped(*parts: str) -> Path:
    """Path of a file shipped with the library (``assets/...`` or ``configs/...``), installed or from a checkout."""
    package = Path(__file__).resolve().parent
    for root in (package / "_data", package.parents[1]):
        path = root.joinpath(*parts)
        if path.exists():
            return path
    raise CfbError(f"{'/'.join(parts)} is missing from this installation of cfb_mjx; reinstall it.")
