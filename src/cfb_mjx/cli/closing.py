"""``cfb close-loop``."""

from __future__ import annotations

from pathlib import Path

from cfb_mjx.cli.fitted_model import provenance, require_apart
from cfb_mjx.errors import CfbError
from cfb_mjx.files import output_folder, require_no_file, together, write_json
from cfb_mjx.logs import FlightLog, read_log, require_own_names
from cfb_mjx.runtime import configure_jax, environment, say

LEAST_SECONDS = 10.0
"""Of flight to fit: below this nothing could be told from chance."""


def run_close_loop(
    fit: list[Path],
    held_out: list[Path],
    output: Path,
    model: str,
    changes: list[str],
    arguments: list[str] | None = None,
) -> None:
    """Trace, judge, write the report and the corrected model.

    ``arguments`` are written into the model's provenance; by default those of this process.

    Raises:
        CfbError: bad logs, a log on both sides, a bad model, or a folder that cannot be written.
    """
    logs, judged = _read(fit, held_out)
    require_no_file(output)
    configure_jax(x64=True)
    from cfb_mjx.parameters import load_model_file, save_model_file
    from cfb_mjx.sysid.tracing.checkpoint import Checkpoint
    from cfb_mjx.sysid.tracing.closing import close_loop
    from cfb_mjx.view.closing import write_report
    from cfb_mjx.view.closing_words import verdict

    base = load_model_file(model, changes)
    output_folder(output)
    checkpoint = Checkpoint.open(output / "search.json", fit, base, say)
    outcome = close_loop(logs, judged, base, say, checkpoint)
    judged_on = [path.name for path in held_out]
    story = provenance("close-loop", base.name, "fit_logs_sha256", fit, arguments, held_out=judged_on)
    corrected = outcome.model_file(f"{base.name}-closed", story)
    facts = environment()
    report = {"case": output.resolve().name, "summary": verdict(outcome)} | outcome.to_json()
    report |= {"model": base.name, "environment": facts}
    say("writing the report")
    with together():
        save_model_file(corrected, output / "model.yaml")
        write_report(outcome, output, facts, logs, judged)
        write_json(output / "report.json", report)
        checkpoint.discard()
    _print(report, output)


def _read(fit: list[Path], held_out: list[Path]) -> tuple[list[FlightLog], list[FlightLog]]:
    if not fit or not held_out:
        raise CfbError("close-loop needs --fit LOG... to learn from and --held-out LOG... to be judged on.")
    require_apart(fit, held_out)
    logs, judged = [read_log(path) for path in fit], [read_log(path) for path in held_out]
    for group in (logs, judged):
        require_own_names(group)
    if sum(log.duration for log in logs) < LEAST_SECONDS:
        raise CfbError(f"--fit: less than {LEAST_SECONDS:g} s of flight; give longer or more logs.")
    return logs, judged


def _with_error(value: float, std: float | None) -> str:
    return f"{value:.4g} (at its bound)" if std is None else f"{value:.4g} +- {std:.2g}"


def _print(report: dict, output: Path) -> None:
    from cfb_mjx.view.closing_words import separating

    if not report["effects"]:
        print("no effect of the catalogue stands" if report["unexplained"] else "nothing is missing beyond chance")
    for effect in report["effects"]:
        values = []
        for key, value in effect["parameters"].items():
            std = effect["uncertainty"].get(key)
            pairs = zip(value, std, strict=True) if isinstance(value, list) else [(value, std)]
            values.append(f"{key} " + ", ".join(_with_error(v, s) for v, s in pairs))
        print(f"{effect['name']}: {'; '.join(values)} (p = {effect['p_value']:.1g})")
        if effect.get("confusable_with"):
            print(f"  these flights hardly tell it from {', '.join(effect['confusable_with'])}")
            command = separating([effect["name"], *effect["confusable_with"]], str(output / "model.yaml"))
            if command is not None:
                print(f"  what to fly: {command}")
    if report["unexplained"]:
        print(f"unexplained: {report['unexplained_because']}")
    print(f"\n{'held-out RMS error':<28}{'before':>10}{'after':>10}{'hold':>10}")
    held = report["held_out"]
    for key, before in held["before"].items():
        if "_rmse_" in key and key.endswith(("@0.2s", "@0.5s")):
            print(f"{key:<28}{before:>10.4g}{held['after'][key]:>10.4g}{held['hold'][key]:>10.4g}")
    print(f"report: {output / 'report.html'}\nmodel: {output / 'model.yaml'}")
