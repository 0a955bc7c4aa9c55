"""Arrays by name (.npz of NumPy, .mat of MATLAB) as the columns of a table."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.logs.tabular import Table

NPZ, MAT = b"PK\x03\x04", b"MATLAB 5.0"
_LARGEST = 1 << 28  # bytes of one array: a flight of an hour at 1 kHz is a tenth of that
_NUMBERS = "biuf"


def kind(head: bytes) -> str:
    """What a file of arrays by name is called."""
    return "the MATLAB file (.mat)" if head.startswith(MAT) else "the NumPy archive (.npz)"


def recognises(path: Path, head: bytes) -> bool:
    """Whether a file holds arrays by name."""
    if head.startswith(MAT):
        return True
    if not head.startswith(NPZ):
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except (zipfile.BadZipFile, OSError):
        return path.suffix.lower() == ".npz"
    return bool(names) and all(name.endswith(".npy") for name in names)


def read_arrays(path: Path) -> Table:
    """The arrays as columns: ``pos`` of (n, 3) becomes ``pos.x``, ``pos.y``, ``pos.z``; of (n, 4) numbers 1 to 4, or
    ``w x y z`` where its rows are unit quaternions.

    Raises:
        CfbError: damaged, objects in place of numbers, or no array as long as a time column.
    """
    with_head = path.read_bytes()[: len(MAT)]
    arrays = _mat(path) if with_head.startswith(MAT) else _npz(path)
    arrays = {name: np.squeeze(values) for name, values in arrays.items() if values.dtype.kind in _NUMBERS}
    lengths = [max(v.shape) for v in arrays.values() if v.ndim and v.size > 1]
    if not lengths:
        raise CfbError(
            f"{path}: {kind(with_head)} holds no arrays of numbers with more than one value; save time and signals by "
            "name."
        )
    rows = max(set(lengths), key=lengths.count)
    table = Table()
    for name, values in arrays.items():
        if rows not in values.shape or values.ndim > 2:
            if values.size > 1:
                table.notes.append(
                    f"array {name} of shape {values.shape} has not the {rows} rows of the others; left out."
                )
            continue
        columns = values.reshape(rows, -1) if values.shape[0] == rows else values.T
        labels = _labels(columns)
        if columns.shape[1] == 1:
            table[name] = columns[:, 0].astype(float)
        elif labels:
            table |= {f"{name}.{label}": column.astype(float) for label, column in zip(labels, columns.T, strict=True)}
        else:
            table.notes.append(
                f"array {name} has {columns.shape[1]} columns, which say nothing of themselves; left out."
            )
    return table


def _labels(columns: np.ndarray) -> str:
    if columns.shape[1] == 4:
        norm = np.linalg.norm(columns.astype(float), axis=1)
        return "wxyz" if np.nanmax(np.abs(norm - 1.0), initial=0.0) < 0.05 else "1234"
    return "xyz" if columns.shape[1] == 3 else ""


def _npz(path: Path) -> dict[str, np.ndarray]:
    found = {}
    try:
        with zipfile.ZipFile(path) as archive:
            for info in archive.infolist():
                if info.file_size > _LARGEST:
                    raise CfbError(
                        f"{path}: {info.filename} would take {info.file_size >> 20} MiB; save single signals."
                    )
        with np.load(path, allow_pickle=False) as archive:
            for name in archive.files:
                found[name] = archive[name]
    except (ValueError, OSError, zipfile.BadZipFile, EOFError, KeyError, MemoryError, zipfile.LargeZipFile) as error:
        if "allow_pickle" in str(error):
            raise CfbError(
                f"{path}: holds Python objects in place of numbers, which could run any code; save plain arrays."
            ) from None
        raise CfbError(f"{path}: the NumPy archive (.npz) is damaged or cut short ({error}); copy it again.") from None
    return found


def _mat(path: Path) -> dict[str, np.ndarray]:
    from scipy.io import loadmat

    try:
        found = loadmat(path, struct_as_record=False)
    except Exception as error:  # of damaged bytes come errors of every kind
        raise CfbError(
            f"{path}: the MATLAB file (.mat) is damaged or of a kind that is not read ({error}); save it with -v7."
        ) from None
    return {name: np.asarray(values) for name, values in found.items() if not name.startswith("__")}
