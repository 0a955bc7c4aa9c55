"""Recognise files of unsupported kinds by their first bytes: the name of the kind, and advice for the user."""

from __future__ import annotations

from pathlib import Path

from cfb_mjx.files import read_bytes

_TO_TABLE = "write its columns as csv or parquet (docs/logs.md has the layout)"
_UNPACK = "unpack it and import what is inside"
# First bytes, name, advice. A longer mark comes before a shorter one with the same beginning.
_MARKS: tuple[tuple[bytes, str, str], ...] = (
    (b"version https://git-lfs.github.com", "a Git LFS pointer, not the file itself", "fetch it with: git lfs pull"),
    (b"#ROSBAG V1", "a ROS 1 bag of an old version", "migrate it with: rosbag fix"),
    (b"\x93NUMPY", "a NumPy array (.npy)", f"save several arrays under their names with numpy.savez, or {_TO_TABLE}"),
    (b"\x89HDF\r\n\x1a\n", "an HDF5 file (or a MATLAB file of version 7.3)", f"load it with h5py and {_TO_TABLE}"),
    (b"RRF", "a rerun recording", f"export it with: rerun rrd, or {_TO_TABLE}"),
    (b"RRIO", "a rerun recording", f"export it with: rerun rrd, or {_TO_TABLE}"),
    (b"\x1f\x8b", "a gzip file", "unpack it with gunzip and import what is inside"),
    (b"BZh", "a bzip2 file", _UNPACK),
    (b"\xfd7zXZ", "an xz file", _UNPACK),
    (b"\x28\xb5\x2f\xfd", "a zstd file", "unpack it with unzstd and import what is inside"),
    (b"7z\xbc\xaf\x27\x1c", "a 7z archive", _UNPACK),
    (b"Rar!", "a RAR archive", _UNPACK),
    (b"%PDF", "a PDF document", "give the log itself"),
    (b"\x89PNG", "a PNG image", "give the log itself"),
    (b"\xff\xd8\xff", "a JPEG image", "give the log itself"),
    (b"\xd0\xcf\x11\xe0", "an old Excel workbook", "save the sheet as csv"),
    (b"ARROW1", "an Arrow (Feather) file", "write it as parquet"),
    (b"Obj\x01", "an Avro file", "write it as parquet"),
    (b"\xa3\x95", "an ArduPilot DataFlash log", f"convert it with mavlogdump.py --format csv and {_TO_TABLE}"),
    (b"H Product:Blackbox", "a Betaflight blackbox log", f"convert it with blackbox_decode and {_TO_TABLE}"),
    (b"\x7fELF", "a program", "give the log itself"),
)
_PICKLE_OPENINGS = (b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05")


def name_of(path: Path, head: bytes) -> tuple[str, str] | None:
    """Name of an unsupported kind of file, and advice; None for any other file.

    Args:
        path: the file.
        head: its first 64 bytes or more, or the whole of a shorter file.
    """
    for mark, name, remedy in _MARKS:
        if head.startswith(mark):
            return name, remedy
    if head.startswith(b"PK\x03\x04"):
        return _zip(path)
    if head.startswith(_PICKLE_OPENINGS):
        numpy_inside = b"numpy" in read_bytes(path, 4096)
        name = "a NumPy pickle" if numpy_inside else "a Python pickle"
        return name, f"a pickle can run any code, so it is not opened; load it where it was made and {_TO_TABLE}"
    if head.lstrip()[:1] in (b"{", b"[") and path.suffix.lower() in (".json", ".jsonl", ".ndjson", ""):
        return "a JSON file", _TO_TABLE
    if head.lstrip()[:5].lower() in (b"<?xml", b"<html", b"<!doc"):
        return "an XML or HTML page", "give the log itself; a download that needs a login often leaves such a page"
    return None


def _zip(path: Path) -> tuple[str, str]:
    suffix = path.suffix.lower()
    if suffix in (".xlsx", ".xlsm", ".ods"):
        return "an Excel workbook", "save the sheet as csv"
    data = read_bytes(path, 1 << 16)
    if b"xl/workbook" in data or b"[Content_Types].xml" in data:
        return "an Excel workbook", "save the sheet as csv"
    if b".npy" in data:
        return "a NumPy archive (.npz)", _TO_TABLE
    return "a zip archive", _UNPACK
