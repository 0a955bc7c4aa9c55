"""Result of ``cfb fly``, and how it is printed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cfb_mjx.commands.command import Result, lines_of

_UNITS = {"mm": "mm", "s": "s", "mps": "m/s", "m": "m", "radps": "rad/s", "deg": "deg"}
_FLOWN = ("controller", "task", "model", "plants", "magnitude", "gyro", "knobs", "path", "environment")
"""Keys of the results that say what was flown."""


@dataclass(frozen=True)
class Flown(Result):
    """How well a controller flew.

    Attributes:
        numbers: the results as ``--json`` writes them, for instance ``numbers["mean_distance_mm"]`` and
            ``numbers["success_rate"]``. For a set of drones they are in ``numbers["on"]``, by the names of the drones.
        files: paths of the files written, by kind; None for a file that was not asked for.
        searched: whether the settings of a flip (``numbers["knobs"]``) were found by a search.
    """

    numbers: Mapping[str, Any]
    files: Mapping[str, Path | None]
    searched: bool = False

    def __str__(self) -> str:
        lines = []
        if self.searched:
            lines.append("knobs: " + ", ".join(f"{name} {x:.4g}" for name, x in self.numbers["knobs"].items()))
        lines += lines_of({"knobs": self.files["knobs"]})
        if "on" in self.numbers:
            width = max(map(len, self.numbers["on"]))
            lines += [_row(name, measured, width) for name, measured in self.numbers["on"].items()]
        else:
            lines += _table(self.numbers)
        return "\n".join([*lines, *lines_of({what: path for what, path in self.files.items() if what != "knobs"})])


def _table(numbers: Mapping[str, Any]) -> list[str]:
    """The results on one model, a line for each number."""
    drones = "drone" if numbers["plants"] == 1 else "drones"
    gyro = "gyro as late as the pose" if numbers["gyro"] == "late" else "gyro on the drone"
    lines = [f"{numbers['controller']}, {numbers['task']}: {numbers['plants']} {drones}, {numbers['model']}, {gyro}"]
    if path := numbers.get("path"):
        lines.append(
            f"  {path['name']}: up to {path['speed_mps']:.3g} m/s, {path['thrust_to_weight']:.3g} times the weight, "
            f"{path['rate_radps']:.3g} rad/s"
        )
    for key, value in numbers.items():
        if key in (*_FLOWN, "quantiles", "diverged"):
            continue
        shown = value if isinstance(value, bool) else "never" if value is None else f"{value:.4g}"
        spread = numbers.get("quantiles", {}).get(key)
        more = (
            "" if not spread or spread["0.5"] is None else f"   median {spread['0.5']:.4g}, 95 % {spread['0.95']:.4g}"
        )
        lines.append(f"  {_label(key):<24}{shown}{more}")
    return lines + ([f"  {_diverged(numbers)}"] if "diverged" in numbers else [])


def _row(name: str, measured: Mapping[str, Any], width: int) -> str:
    """The results on one drone of a set, in one line."""
    shown = [
        f"{_label(key)} {value:.4g}"
        for key, value in measured.items()
        if isinstance(value, float) and key not in ("failure_rate", "success_rate")
    ]
    lost = "   failed" if measured["failed"] and "failure_rate" not in measured else ""
    if measured.get("failure_rate"):
        lost = f"   {measured['failure_rate']:.0%} failed"
    if measured.get("success_rate", 1.0) < 1:
        lost += f"   {measured['success_rate']:.0%} succeeded"
    lost += "".join(f"   not {end}" for end, value in measured.items() if value is False and end != "failed")
    lost += f"   {_diverged(measured)}" if "diverged" in measured else ""
    return f"  {name:<{width}}  {'   '.join(shown)}{lost}"


def _diverged(measured: Mapping[str, Any]) -> str:
    return f"{measured['diverged']} diverged (states not finite): they count as failed and are left out of the means"


def _label(key: str) -> str:
    name, _, unit = key.rpartition("_")
    return (f"{name} [{_UNITS[unit]}]" if unit in _UNITS else key).replace("_", " ")
