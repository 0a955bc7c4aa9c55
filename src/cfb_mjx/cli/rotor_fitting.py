"""``cfb fit-rotors``: motors and rotor maps on their own, from flights with rotor speed and from bench tables."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict, replace
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cfb_mjx.cli.fitted_model import provenance, require_model_path
from cfb_mjx.errors import CfbError
from cfb_mjx.files import read_bytes, require_folder, together, write_json
from cfb_mjx.logs import FlightLog, read_log
from cfb_mjx.logs.bench_layouts import Bench, read_bench_table, recognises
from cfb_mjx.logs.bench_points import SteadyPoints, ThrustPoints, joined
from cfb_mjx.logs.bench_tables import MapTable
from cfb_mjx.logs.flown import flown_part
from cfb_mjx.logs.tabular import read_table
from cfb_mjx.parameters import load_model_file
from cfb_mjx.runtime import Progress, configure_jax, environment
from cfb_mjx.terminal import print_paths

if TYPE_CHECKING:
    from cfb_mjx.parameters import ModelFile
    from cfb_mjx.sysid.rotors.motors import MotorFit
    from cfb_mjx.sysid.rotors.rotor_maps import MapFit
    from cfb_mjx.sysid.rotors.steady import SteadyFit
    from cfb_mjx.sysid.rotors.thrust_in_flight import ThrustInFlight

_COLUMN = {"thrust": "force", "torque": "torque"}
_FOUR_LEAST = 2.5
_LIMIT = "the model file has one time constant per motor and no dead time"


def run_fit_rotors(
    paths: list[Path],
    output: Path,
    model: str,
    changes: list[str],
    offset: bool = False,
    asymmetric: bool = False,
    dead_time: bool = False,
    per_motor: bool = False,
    robust: bool = False,
    json: Path | None = None,
    figure: Path | None = None,
    tared: bool = False,
    rotors: int | None = None,
) -> None:
    """Fit what the files hold, print a table, write the model.

    Raises:
        CfbError: bad files, nothing that can be fitted, or outputs that cannot be written.
    """
    require_folder(output, json, figure)
    require_model_path(output)
    if figure is not None:
        from cfb_mjx.view.style import check_path

        check_path(figure)
    records, tables, points, flights, notes = _read(paths, rotors)
    configure_jax(x64=True)
    from cfb_mjx.parameters import save_model_file

    base = load_model_file(model, changes)
    _require_one_rotor(tables, base)
    motors = None
    extras = {"offset": offset, "asymmetric": asymmetric, "dead_time": dead_time}
    if records:
        from cfb_mjx.sysid.rotors.supply import fit_under_supply

        progress = Progress("fitting motors")
        motors, said = fit_under_supply(records, base.parameters(), **extras, per_motor=per_motor, progress=progress)
        notes += said
    steady = None
    if points and not records:
        from cfb_mjx.sysid.rotors.steady import fit_steady

        steady = fit_steady(points)
    elif points:
        notes.append("steady points were not used: command steps tell gain and offset too, and the lag.")
    maps = _fit_maps(tables, base, per_motor, robust, tared)
    pulls = _in_flight(flights, base)
    corrected, written = _corrected(base, motors, steady, maps, output, paths)
    if not written:
        reasons = "; ".join(motors.common.unidentifiable.values()) if motors else ""
        raise CfbError(f"{', '.join(p.name for p in paths)}: cannot tell any constant of the model ({reasons}).")
    with together():
        save_model_file(corrected, output)
        if json is not None:
            flown = {} if pulls is None else {"thrust_in_flight": asdict(pulls)}
            write_json(json, _json(motors, steady, maps, base, written) | flown)
        if figure is not None:
            from cfb_mjx.sysid.rotors.motor_replay import replay
            from cfb_mjx.view.rotors import rotor_figure

            rotor_figure(replay(motors) if motors else [], maps, figure, output.stem)
    _print(motors, steady, maps, base, {name for name, on in extras.items() if on})
    if pulls is not None:
        print(
            f"thrust in flight: {pulls.ratio:.3f} +- {pulls.ratio_std:.3f} times the curve of {base.name} at the same "
            f"rotor speeds, by the specific force of {1e3 * pulls.mass:.1f} g (not written: cfb refine takes "
            "thrust_scale from predictions)"
        )
    for note in notes:
        print(note)
    print(f"model: {output} ({', '.join(written)})")
    if motors and motors.common.extras - {"offset"}:
        print(f"spin-up and spin-down constants and dead time are reported only: {_LIMIT}.")
    print_paths(results=json, figure=figure)


def _read(paths: list[Path], rotors: int | None):
    """Every file by its content: bench tables by their columns, all else as a flight.

    Returns:
        Records of motors in time, maps, steady points, flights, and notes on how they were read.
    """
    records, tables, points, thrust, flights, notes = [], [], [], [], [], []
    for path in paths:
        found = _bench(path, rotors)
        if found is None:
            from cfb_mjx.sysid.rotors.motor_tracks import record_of

            log = read_log(path, keep_ground=True)
            record = record_of(log)
            if record is None:
                raise CfbError(f"{path}: holds no rotor speeds; log them, or leave this flight out.")
            found = Bench([record], [])
            flights.append(log)
        notes += found.notes
        for part in found.parts:
            kinds = {MapTable: tables, SteadyPoints: points, ThrustPoints: thrust}
            kinds.get(type(part), records).append(part)
    tables += [joined(part, points, rotors, notes) for part in thrust]
    return records, tables, points, flights, notes


def _in_flight(logs: list[FlightLog], base: ModelFile) -> ThrustInFlight | None:
    from cfb_mjx.sysid.rotors.thrust_in_flight import thrust_in_flight

    flown = []
    for log in logs:
        with suppress(CfbError):  # motors on the ground are a recording of motors all the same
            flown.append(flown_part(log, Path(log.name)))
    return thrust_in_flight(flown, base.parameters())


def _bench(path: Path, rotors: int | None) -> Bench | None:
    head = read_bytes(path, 4)
    if path.suffix.lower() not in (".csv", ".txt", ".tsv", ".parquet") and head != b"PAR1":
        return None
    table = read_table(path)
    return read_bench_table(table, path, rotors) if recognises(table) else None


def _require_one_rotor(tables: list[MapTable], base: ModelFile) -> None:
    """Refuse thrust that is plainly that of four rotors, or a quarter of one's: no propeller this drone carries differs
    that much from another."""
    from cfb_mjx.parameters import load_model_file, preset_names

    for table in tables:
        ratio = _pull(table, base)
        if ratio is None:
            continue
        top = int(np.argmax(table.rotor_speed))
        point = f"{table.force[top]:.3g} N at {table.rotor_speed[top]:.0f} rad/s"
        if ratio > _FOUR_LEAST:
            raise CfbError(
                f"{table.name}: {point} is {ratio:.1f} times what one rotor of {base.name} pulls, so it is the thrust "
                "of four; give --rotors 4."
            )
        others = {name: _pull(table, load_model_file(name)) for name in preset_names() if ratio < 1 / _FOUR_LEAST}
        like = min((n for n, r in others.items() if r), key=lambda n: abs(np.log(others[n])), default=None)
        if like is not None and 1 / _FOUR_LEAST < others[like] < _FOUR_LEAST:
            raise CfbError(
                f"{table.name}: {point} is {ratio:.2f} of what a rotor of {base.name} pulls and {others[like]:.2f} of "
                f"one of {like}; give --model {like}, or --rotors 1 if the thrust of one had been divided by four."
            )
        if ratio < 1 / _FOUR_LEAST:
            raise CfbError(
                f"{table.name}: {point} is {ratio:.2f} of what a rotor of {base.name} pulls, as if the thrust of one "
                "had been divided by four; give --rotors 1, or correct its unit."
            )


def _pull(table: MapTable, model: ModelFile) -> float | None:
    """Thrust of fast points over what a model's rotor pulls at their speeds; None where it cannot be told."""
    from cfb_mjx.sysid.rotors.rotor_maps import powers

    if table.force is None:
        return None
    sigma = float(model.entries["reference_rotor_speed"].value)
    curve = np.asarray(model.entries["thrust_polynomial"].value, float) * np.mean(model.entries["thrust_scale"].value)
    usual = powers(table.rotor_speed, sigma) @ curve
    fast = (table.rotor_speed > 0.6 * float(table.rotor_speed.max())) & (usual > 0)
    return float(np.median(table.force[fast] / usual[fast])) if fast.any() else None


def _fit_maps(tables: list[MapTable], base: ModelFile, per_motor: bool, robust: bool, tared: bool) -> dict[str, MapFit]:
    from cfb_mjx.sysid.rotors.rotor_maps import fit_map

    found = {}
    for name, column in _COLUMN.items():
        used = [t for t in tables if getattr(t, column) is not None]
        if not used:
            continue
        motor = np.concatenate([t.motor for t in used])
        label = ", ".join(t.name for t in used)
        if per_motor and (motor == 0).any():
            raise CfbError(f"{label}: does not say which motor each point is of; add a column motor (1 to 4).")
        found[name] = fit_map(
            np.concatenate([t.rotor_speed for t in used]),
            np.concatenate([getattr(t, column) for t in used]),
            motor,
            robust=robust,
            per_motor=per_motor,
            sigma=float(base.entries["reference_rotor_speed"].value),
            name=f"{label} ({name})",
            tared=tared,
        )
    return found


def _corrected(base: ModelFile, motors, steady, maps, output: Path, paths: list[Path]) -> tuple[ModelFile, list[str]]:
    """The model with what was identified, and the names of what changed."""
    from cfb_mjx.parameters import Entry
    from cfb_mjx.sysid.rotors.motors import ENTRIES

    source = f"cfb fit-rotors on {len(paths)} file(s), {date.today().isoformat()}"
    entries, written = dict(base.entries), []

    def put(key: str, value: np.ndarray, std: np.ndarray | None) -> None:
        entries[key] = Entry(np.asarray(value, dtype=float), source, std)
        written.append(key)

    for name in ENTRIES if motors else ():
        found = motors.values(name)
        if found is not None:
            put(name, *found)
    if steady is not None:
        put("motor_gain", np.asarray(steady.gain), np.asarray(steady.gain_std))
        put("motor_speed_offset", np.asarray(steady.offset), np.asarray(steady.offset_std))
    for name, fitted in maps.items():
        put(f"{name}_polynomial", fitted.coefficients, fitted.std)
        # The factors belong to the curve: old ones would count twice.
        scale, std = np.ones(4), np.zeros(4)
        for motor, value, deviation in zip(fitted.motors, fitted.scale, fitted.scale_std, strict=True):
            scale[motor - 1], std[motor - 1] = value, deviation
        if len(fitted.motors) or np.any(base.entries[f"{name}_scale"].value != 1):
            put(f"{name}_scale", scale, std if len(fitted.motors) else None)
    origin = provenance("fit-rotors", base.name, "files_sha256", paths)
    description = f"{base.name} with rotors fitted to {', '.join(path.name for path in paths)}"
    return replace(base, entries=entries, name=output.stem, description=description, provenance=origin), written


def _coefficients(maps: dict[str, MapFit], base: ModelFile) -> dict[str, dict]:
    """Coefficients and factors as rows of the table; presets on the base model's own reference speed."""
    rows = {}
    for name, fitted in maps.items():
        unit = "N" if name == "thrust" else "N m"
        old = base.entries[f"{name}_polynomial"].value * np.mean(base.entries[f"{name}_scale"].value)
        for power, value, std, preset in zip("321", fitted.coefficients, fitted.std, old, strict=True):
            rows[f"{name}_s{power}"] = {"value": value, "std": std, "unit": unit, "preset": preset}
        if fitted.offset_std:
            rows[f"{name}_offset"] = {"value": fitted.offset, "std": fitted.offset_std, "unit": unit, "preset": 0.0}
        scales = base.entries[f"{name}_scale"].value
        for motor, value, std in zip(fitted.motors, fitted.scale, fitted.scale_std, strict=True):
            rows[f"{name}_scale_M{motor}"] = {"value": value, "std": std, "unit": "1", "preset": scales[motor - 1]}
    return rows


def _rows(group) -> dict[str, dict]:
    return {
        name: {"value": e.value, "std": e.std, "unit": e.unit, "preset": e.preset}
        for name, e in group.estimates.items()
    }


def _group_json(group) -> dict:
    noise = group.motor
    return {
        "parameters": _rows(group),
        "fitted_with": sorted(group.extras),
        "unidentifiable": list(group.unidentifiable),
        "unidentifiable_because": group.unidentifiable,
        "extras": {
            t.name: {"p_value": t.p_value, "bic_gain": t.bic_gain, "supported": t.supported} for t in group.tests
        },
        "noise": {"reading_radps": noise.reading, "walk_radps_per_sqrt_s": noise.walk, "wander_radps": noise.wander},
        "innovation_lag_one_correlation": group.optimum.whiteness,
        "share_of_rows_beyond_5_std": group.optimum.outliers,
        "rows": group.optimum.rows,
    }


def _steady_rows(steady: SteadyFit | None, base: ModelFile) -> dict[str, dict]:
    if steady is None:
        return {}
    return {
        f"motor_{name}": {
            "value": getattr(steady, short),
            "std": getattr(steady, f"{short}_std"),
            "unit": "rad/s",
            "preset": float(np.mean(base.entries[f"motor_{name}"].value)),
        }
        for name, short in (("gain", "gain"), ("speed_offset", "offset"))
    }


def _json(
    motors: MotorFit | None, steady: SteadyFit | None, maps: dict[str, MapFit], base: ModelFile, written: list[str]
) -> dict:
    told = (_rows(motors.common) if motors else {}) | _steady_rows(steady, base)
    result: dict = {"parameters": told | _coefficients(maps, base)}
    if steady is not None:
        result["steady"] = {
            "gain_per_volt": steady.per_volt,
            "battery_sag_slope": steady.sag_slope,
            "spread_radps": steady.spread,
            "spread_without_voltage_radps": steady.spread_without_voltage,
            "share_of_outliers": steady.outliers,
            "points": steady.points,
        }
    result["unidentifiable"] = list(motors.common.unidentifiable) if motors else []
    if motors:
        result["motors"] = {"all": _group_json(motors.common)}
        result["motors"] |= {f"M{n}": _group_json(group) for n, group in motors.motors.items()}
        result["motors_differ_p_value"] = motors.differences
    result["maps"] = {
        name: {
            "coefficients": m.coefficients,
            "covariance": m.covariance,
            "reference_rotor_speed_radps": m.sigma,
            "noise": m.noise[0],
            "offset": m.offset,
            "offset_std": m.offset_std,
            "increasing_where_measured": m.shape.increasing_where_measured,
            "notes": m.shape.notes(),
            "scales_equal_p_value": m.scale_p_value,
            "points": {
                "motor": m.motor,
                "rotor_speed_radps": m.rotor_speed,
                "measured": m.value,
                "residual": m.residual,
                "weight": m.weight,
            },
        }
        for name, m in maps.items()
    }
    return result | {"written_to_model": written, "environment": environment()}


def _print(
    motors: MotorFit | None, steady: SteadyFit | None, maps: dict[str, MapFit], base: ModelFile, asked: set[str]
) -> None:
    print(f"{'constant':<26}{'value':>12}{'std':>11}  {'unit':<8}{'preset':>11}{'change':>9}")
    groups = {"": motors.common, **{f" M{n}": g for n, g in motors.motors.items()}} if motors else {}
    for suffix, group in groups.items():
        _print_rows({name + suffix: row for name, row in _rows(group).items()})
    _print_rows(_steady_rows(steady, base) | _coefficients(maps, base))
    if steady is not None:
        out = f", {steady.outliers:.0%} of them left out as outliers" if steady.outliers else ""
        print(f"steady speed: {steady.points} points about a line, spread {steady.spread:.1f} rad/s{out}")
        if steady.per_volt is not None:
            print(
                f"steady speed follows command times voltage, omega = {steady.offset:.0f} + {steady.per_volt:.0f} u "
                f"V; a line in u alone leaves {steady.spread_without_voltage:.1f} rad/s. The gain is that at 3.7 V; "
                f"the effect battery_sag with slope {steady.sag_slope:.2f} makes a model follow the voltage."
            )
    for suffix, group in groups.items():
        for reason in dict.fromkeys(group.unidentifiable.values()):
            print(f"not identifiable{suffix}: {reason}")
    for test in motors.common.tests if motors else ():
        verdict = "supported by the data" if test.supported else "not supported by the data"
        hint = ""
        if test.supported and test.name not in asked:
            hint = "; the fit allows for it"
        print(f"{test.name.replace('_', ' ')}: {verdict} (p = {test.p_value:.2g}, BIC {-test.bic_gain:+.1f}){hint}")
    for name, p in (motors.differences if motors else {}).items():
        if p < 0.01:
            print(f"the motors differ in {name} (p = {p:.2g})")
    if motors:
        best = motors.common.optimum
        print(
            f"rows {best.rows}; innovations: lag-one correlation {best.whiteness:+.3f}, "
            f"{best.outliers:.2%} beyond 5 standard deviations"
        )
    for name, m in maps.items():
        unit = "N" if name == "thrust" else "N m"
        print(f"{name}: {len(m.value)} points, noise {m.noise[0]:.2g} {unit}, {len(m.outliers)} outliers")
        if m.offset_std:
            print(
                f"{name}: every point reads {m.offset:+.3g} {unit} too much ({abs(m.offset) / m.offset_std:.0f} std): "
                "a scale that was not tared; fitted as an offset and left out of the curve."
            )
        for note in m.shape.notes():
            print(f"{name}: {note}")
        if np.isfinite(m.scale_p_value):
            word = "differ" if m.scale_p_value < 0.01 else "do not differ significantly"
            print(f"{name}: the motors {word} (p = {m.scale_p_value:.2g})")


def _print_rows(rows: dict[str, dict]) -> None:
    for name, row in rows.items():
        change = f"{row['value'] / row['preset'] - 1:+.1%}" if row["preset"] else ""
        numbers = f"{row['value']:>12.4g}{row['std']:>11.2g}  {row['unit']:<8}{row['preset']:>11.4g}{change:>9}"
        print(f"{name:<26}{numbers}".rstrip())
