"""Effects from outside the package: those registered, those of installed packages, and those of files.

Without jax, since commands note their files here before anything heavy is loaded. Packages and files are read when an
effect is first looked up (`cfb_mjx.model.effects.catalogue`).
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from hashlib import sha256
from importlib import metadata
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from types import ModuleType

from cfb_mjx.errors import CfbError
from cfb_mjx.optional import not_none

GROUP = "cfb_mjx.effects"
"""Entry points of installed packages: an effect, or a module with effects."""


@dataclass(frozen=True)
class _Outside:
    """All that is known at a time."""

    kinds: Mapping[str, type] = field(default_factory=dict)
    files: tuple[Path, ...] = ()
    read: bool = False
    """Whether packages and files have been."""


_outside = _Outside()
_lock = threading.RLock()
_reading = False


@contextmanager
def plugged(*paths: str | Path) -> Iterator[None]:
    """A block in which the effects of Python files are known; afterwards everything is as before.

    Effects registered within are forgotten too, so that tests and notebooks leave nothing behind.

    Raises:
        CfbError: no such file.
    """
    global _outside
    for path in map(Path, paths):
        if path.suffix != ".py" or not path.is_file():
            raise CfbError(f"{path}: no such plugin; give a Python file (.py) that defines effects.")
    before = _outside
    if paths:
        _outside = replace(before, files=(*before.files, *map(Path, paths)), read=False)
    try:
        yield
    finally:
        _outside = before


def files() -> tuple[Path, ...]:
    """The files plugged in here."""
    return _outside.files


def kinds(take: Callable[[object], None]) -> Mapping[str, type]:
    """Effects from outside by name.

    Args:
        take: registers (`add`) what an entry point or a file holds; called for what has not been read yet.

    Raises:
        CfbError: a package or file that cannot be loaded, or holds no effect, or one that is refused.
    """
    global _outside, _reading
    with _lock:
        # What is being read may look effects up itself.
        if not (_outside.read or _reading):
            _reading = True
            try:
                for where, load in _sources():
                    _read(where, load, take)
                _outside = replace(_outside, read=True)
            finally:
                _reading = False
        return _outside.kinds


def add(name: str, kind: type) -> None:
    """Make an effect known.

    Raises:
        CfbError: another one has the name.
    """
    global _outside
    with _lock:
        there = _outside.kinds.get(name, kind)
        # A notebook's cell or a module that runs again defines the same class anew.
        if _place(there) != _place(kind):
            raise CfbError(f"effect {kind.__qualname__}: {there.__qualname__} has the name {name!r} already.")
        _outside = replace(_outside, kinds={**_outside.kinds, name: kind})


def _place(kind: type) -> tuple[str, str]:
    return kind.__module__, kind.__qualname__


def _sources() -> Iterator[tuple[str, Callable[[], object]]]:
    for point in metadata.entry_points(group=GROUP):
        package = point.dist.name if point.dist else "an installed package"
        yield f"{package}, entry point {GROUP}: {point.name} = {point.value}", point.load
    for path in _outside.files:
        yield str(path), lambda path=path: _module(path)


def _read(where: str, load: Callable[[], object], take: Callable[[object], None]) -> None:
    try:
        take(load())
    except CfbError as error:
        raise CfbError(f"{where}: {error}") from error
    except (Exception, SystemExit) as error:
        raise CfbError(f"{where}: cannot be loaded: {type(error).__name__}: {error}{_line(where, error)}.") from error


def _line(where: str, error: BaseException) -> str:
    found, trace = None, error.__traceback__
    while trace is not None:
        found = trace.tb_lineno if trace.tb_frame.f_code.co_filename == where else found
        trace = trace.tb_next
    return "" if found is None else f" (line {found})"


def _module(path: Path) -> ModuleType:
    """A file as a module; the one there is, if the file has not changed, so that what was compiled for it serves."""
    source = path.read_bytes()
    name = f"{__name__}.{path.stem}_{sha256(str(path.resolve()).encode()).hexdigest()[:12]}"
    digest = sha256(source).hexdigest()
    there = sys.modules.get(name)
    if there is not None and there.__digest__ == digest:
        return there
    # Executed here, not by the import system: that would leave compiled files beside the user's.
    module = module_from_spec(not_none(spec_from_loader(name, None, origin=str(path))))
    module.__file__ = str(path)
    vars(module)["__digest__"] = digest
    sys.modules[name] = module
    try:
        exec(compile(source, str(path), "exec", dont_inherit=True), vars(module))
    except BaseException:
        del sys.modules[name]
        raise
    return module
