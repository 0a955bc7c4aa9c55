"""Reader of named arrays (.npz of NumPy, .mat of MATLAB) as the columns of a table."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from cfb_mjx.errors import CfbError
from cfb_mjx.logs import rotation
from cfb_mjx.logs.tabular import Table

NPZ, MAT = b"PK\x03\x04", b"MATLAB 5.0"
_LARGEST = 1 << 28  # bytes of one array; a flight of one hour at 1 kHz needs a tenth of that
_NUMBERS = "biuf"
_LARGE = 0.25  # mean square of a component of a unit quaternion


def kind(head: bytes) -> str:
    """Name of the file format, for messages."""
    return "the MATLAB file (.mat)" if head.startswith(MAT) else "the NumPy archive (.npz)"


def recognises(path: Path, head: bytes) -> bool:
    """Whether a file holds named arrays."""
    if head.startswith(MAT):
        return True
    if not head.startswith(NPZ):
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except Exception:  # damaged bytes raise errors of every kind
        return path.suffix.lower() == ".npz"
    return bool(names) and all(name.endswith(".npy") for name in names)


def read_arrays(path: Path) -> Table:
    """Read the arrays as columns of a table.

    ``pos`` of shape (n, 3) becomes ``pos.x``, ``pos.y``, ``pos.z``. The columns of an (n, 4) array are numbered 1 to 4,
    or named ``w x y z`` (or ``x y z w``) if its rows are unit quaternions.

    Raises:
        CfbError: the file is damaged, holds objects instead of numbers, holds several drones, or holds no arrays of
            more than one value.
    """
    with_head = path.read_bytes()[: len(MAT)]
    arrays = _mat(path) if with_head.startswith(MAT) else _npz(path)
    if set(arrays) >= {"timestamps", "states"} and arrays["states"].ndim == 3 and arrays["states"].shape[1] == 16:
        return _of_pybullet(path, arrays)
    arrays = {name: np.squeeze(values) for name, values in arrays.items() if values.dtype.kind in _NUMBERS}
    lengths = [max(v.shape) for v in arrays.values() if v.ndim and v.size > 1]
    if not lengths:
        raise CfbError(
            f"{path}: {kind(with_head)} holds no arrays of numbers with more than one value; save time and signals as "
            "named arrays."
        )
    rows = max(set(lengths), key=lengths.count)
    for name, values in arrays.items():
        if values.ndim > 2 and rows in values.shape and values.shape[-1] in (3, 4):
            raise CfbError(
                f"{path}: array {name} has shape {values.shape}, so it holds several drones; save the arrays of one."
            )
    table = Table()
    for name, values in arrays.items():
        if rows not in values.shape or values.ndim > 2:
            if values.size > 1:
                table.warnings.append(
                    f"array {name} of shape {values.shape} does not have the {rows} rows of the others; left out."
                )
            continue
        columns = values.reshape(rows, -1) if values.shape[0] == rows else values.T
        labels = _labels(columns)
        if columns.shape[1] == 1:
            table[name] = columns[:, 0].astype(float)
        elif labels:
            if labels == "xyzw":
                table.notes.append(
                    f"array {name} was read as a quaternion x, y, z, w: its first column is small throughout."
                )
            table |= {f"{name}.{label}": column.astype(float) for label, column in zip(labels, columns.T, strict=True)}
        else:
            table.warnings.append(f"array {name} has {columns.shape[1]} columns, whose meaning is unknown; left out.")
    return table


def _of_pybullet(path: Path, arrays: dict[str, np.ndarray]) -> Table:
    """Columns of a log of gym-pybullet-drones.

    Its states are position, velocity, Euler angles, angular velocity in *world* axes, and rpm.
    """
    states, time = arrays["states"], np.atleast_2d(arrays["timestamps"])
    if len(states) != 1:
        raise CfbError(f"{path}: holds the flights of {len(states)} drones; save them one by one.")
    position, velocity, angles, turning, rpm = np.split(states[0].T.astype(float), [3, 6, 9, 12], axis=1)
    quaternion = rotation.from_euler(angles)
    rate = rotation.to_body(quaternion, turning)
    said = "a log of gym-pybullet-drones: its angular velocity was rotated from world to body axes."
    table = Table({"t": time[0].astype(float)}, [said])
    for stem, values in (("pos_", position), ("vel_", velocity), ("gyro_", rate)):
        table |= {f"{stem}{axis}": column for axis, column in zip("xyz", values.T, strict=True)}
    table |= {f"quat_{axis}": column for axis, column in zip("wxyz", quaternion.T, strict=True)}
    table |= {f"rpm{i}": column for i, column in enumerate(rpm.T, 1)}
    return table


def _labels(columns: np.ndarray) -> str:
    if columns.shape[1] == 4:
        norm = np.linalg.norm(columns.astype(float), axis=1)
        if np.nanmax(np.abs(norm - 1.0), initial=0.0) >= 0.05:
            return "1234"
        # A drone mostly flies level, so x stays small: a large first column is w. A small first column is x, or the w
        # of a drone that faces backwards throughout; the checks of the log detect that case.
        return "wxyz" if np.nanmean(columns[:, 0].astype(float) ** 2) > _LARGE else "xyzw"
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
    except CfbError:
        raise
    except Exception as error:  # damaged bytes raise errors of every kind
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
    except Exception as error:  # damaged bytes raise errors of every kind
        raise CfbError(
            f"{path}: the MATLAB file (.mat) is damaged or of an unsupported version ({error}); save it with -v7."
        ) from None
    return {name: np.asarray(values) for name, values in found.items() if not name.startswith("__")}
