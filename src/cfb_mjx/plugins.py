"""Effects from outside the package: registered ones, those of installed packages, and those of files.

This module does not import jax, because commands register their files here before they load anything heavy. Packages
and files are read when an effect is first looked up (`cfb_mjx.model.effects.catalogue`).
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
"""Group of entry points of installed packages; each is an effect or a module with effects."""


@dataclass(frozen=True)
class _Outside:
    """The effects from outside, and the files that are still to be read."""

    kinds: Mapping[str, type] = field(default_factory=dict)
    files: tuple[Path, ...] = ()
    read: bool = False
    """Whether packages and files have been read."""


_outside = _Outside()
_lock = threading.RLock()
_reading = False


@contextmanager
def plugged(*paths: str | Path) -> Iterator[None]:
    """Make the effects of Python files available during a block.

    At its end all effects that were added in the block are removed, also registered ones, so that tests and notebooks
    have no side effects.

    Args:
        paths: Python files that define effects.

    Raises:
        CfbError: a file does not exist.
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
    """Return the plugin files of the enclosing blocks."""
    return _outside.files


def kinds(take: Callable[[object], None]) -> Mapping[str, type]:
    """Return the effects from outside by name.

    Args:
        take: function that registers (`add`) the effects of an entry point or a file; called for those not read yet.

    Raises:
        CfbError: a package or file cannot be loaded, or has no effect or an invalid one.
    """
    global _outside, _reading
    with _lock:
        # A plugin may look up effects while it is being read.
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
    """Register an effect.

    Raises:
        CfbError: another effect has the name.
    """
    global _outside
    with _lock:
        there = _outside.kinds.get(name, kind)
        # A notebook cell or module that runs again defines the same class again.
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
    """Load a file as a module, or return the loaded one if the file is unchanged, to reuse its compiled programs."""
    source = path.read_bytes()
    name = f"{__name__}.{path.stem}_{sha256(str(path.resolve()).encode()).hexdigest()[:12]}"
    digest = sha256(source).hexdigest()
    there = sys.modules.get(name)
    if there is not None and there.__digest__ == digest:
        return there
    # The import system would write compiled files into the user's folder.
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
