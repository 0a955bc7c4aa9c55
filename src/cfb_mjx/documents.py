"""Strict reading of YAML documents: shipped ones by name, the user's by path."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Hashable, Mapping
from pathlib import Path
from typing import Any

import yaml

from cfb_mjx.errors import CfbError
from cfb_mjx.files import shipped

LARGEST_INT = 2**63 - 1
LARGEST_SEED = 2**32 - 1
"""In single precision jax uses only 32 bits of a seed; larger seeds would repeat the draws of smaller ones."""
_REPR = reprlib.Repr()
_REPR.maxlevel, _REPR.maxstring, _REPR.maxother = 3, 80, 80
LONGEST = 160


def shipped_names(*folder: str) -> list[str]:
    """Return the names of the YAML files in a folder of ``configs``."""
    return sorted(path.stem for path in shipped("configs", *folder).glob("*.yaml"))


def load_named(name_or_path: str | Path, what: str, format: str, *folder: str) -> tuple[Path, dict]:
    """Return the path and the content of a YAML file, or of a shipped one that is named without suffix.

    Args:
        name_or_path: path or name of the document.
        what: kind of the document, for messages.
        format: required value of its entry ``format``.
        folder: folder of ``configs`` with the shipped documents.

    Raises:
        CfbError: no such file, not a YAML mapping, or another format.
    """
    path = Path(name_or_path)
    if path.suffix not in (".yaml", ".yml"):
        names = shipped_names(*folder)
        if str(name_or_path) not in names:
            raise CfbError(f"{name_or_path}: no such {what}; give a YAML file or one of {', '.join(names)}.")
        path = shipped("configs", *folder, f"{name_or_path}.yaml")
    document = load_yaml(path)
    if document.get("format") != format:
        raise CfbError(f"{path}: 'format' must be '{format}', found {told(document.get('format'))}.")
    return path, document


def load_yaml(path: str | Path) -> dict:
    """Read a YAML mapping.

    Raises:
        CfbError: the file is missing, unreadable, not YAML or not a mapping, has a duplicate key or a whole number of
            more than 64 bits, or contains itself.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except FileNotFoundError:
        raise CfbError(f"{path}: there is no such file; check the path.") from None
    except (OSError, UnicodeDecodeError) as error:
        raise CfbError(f"{path}: cannot be read as text ({error}).") from None
    document = parse_yaml(text, str(path))
    if not isinstance(document, dict):
        raise CfbError(f"{path}: must hold a YAML mapping, found {type(document).__name__}.")
    return document


def parse_yaml(text: str, where: str) -> Any:
    """Parse a YAML text, as strictly as a file.

    Args:
        text: the text.
        where: name of the text in messages.

    Raises:
        CfbError: the text is not valid.
    """
    try:
        document = yaml.load(text, Loader=_StrictLoader)
        _require_plain(document, (), (), set())
    # PyYAML raises many kinds of errors: !!bool x a KeyError, a thirteenth month a ValueError, and so on.
    except Exception as error:
        said = "nested too deeply" if isinstance(error, RecursionError) else "a value that does not fit its tag"
        if isinstance(error, yaml.YAMLError | ValueError):
            said = " ".join(str(error).split())
        raise CfbError(f"{where}: is not valid YAML ({said}).") from None
    return document


def told(value: Any) -> str:
    """Return a value as messages quote it: on one line and shortened."""
    text = _REPR.repr(value)
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 3]}..."


def require_seed(seed: int, where: str) -> None:
    """Refuse a seed that jax would truncate.

    Raises:
        CfbError: the seed is negative or above `LARGEST_SEED`.
    """
    if not 0 <= seed <= LARGEST_SEED:
        raise CfbError(f"{where} {seed} must be from 0 to {LARGEST_SEED}.")


def with_former(written: dict[str, Any], key: str, former: dict[str, Any]) -> dict[str, Any]:
    """Return a group of settings with the values that keys of ``former`` had before they existed, if it has ``key``.

    A group that was written out by an earlier version has ``key`` but not the keys of ``former``.
    """
    return former | written if key in written else written


def is_named(value: Any) -> bool:
    """Whether this is a mapping with text keys and a ``name``, such as an effect."""
    return isinstance(value, dict) and all(isinstance(k, str) for k in value) and isinstance(value.get("name"), str)


def _require_plain(value: Any, at: tuple[str, ...], within: tuple[int, ...], known: set[int]) -> None:
    where = f"{'.'.join(at)} is " if at else ""
    if isinstance(value, int) and abs(value) > LARGEST_INT:
        raise yaml.YAMLError(f"{where}a whole number of more than 64 bits; write it with a decimal point")
    if isinstance(value, dict | list | tuple | set) and id(value) not in known:
        if id(value) in within:
            raise yaml.YAMLError(f"{where}something that contains itself")
        if isinstance(value, dict):
            for key in value:
                _require_plain(key, at, within, known)
        for key, part in value.items() if isinstance(value, dict) else enumerate(value):
            _require_plain(part, (*at, str(key)), (*within, id(value)), known)
        # Values that anchors repeat are checked once.
        known.add(id(value))


class _StrictLoader(yaml.SafeLoader):
    """Loader that refuses duplicate keys and reads 1e-5 as a number (YAML 1.1 requires a dot and a sign)."""

    def construct_mapping(self, node, deep=False):
        seen = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, Hashable):
                raise yaml.YAMLError("a key must be plain text")
            if key in seen:
                raise yaml.YAMLError(f"the key '{key}' appears twice (line {key_node.start_mark.line + 1})")
            seen.add(key)
        return super().construct_mapping(node, deep)


_StrictLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"), list("-+.0123456789")
)


def refuse_unknown(found: Mapping, known: set[str], path, prefix: str) -> None:
    """Refuse keys of a mapping that are not among the known ones.

    Raises:
        CfbError: there are unknown keys; the message names them.
    """
    unknown = [str(key) for key in found if key not in known]
    if unknown:
        names = ", ".join(f"'{prefix}{key}'" for key in unknown)
        raise CfbError(f"{path}: unknown key {names}; known here are {', '.join(sorted(known))}.")
