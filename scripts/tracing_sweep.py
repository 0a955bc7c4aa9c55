"""Run `cfb close-loop` on many drones of the reference simulator, and write docs/tracing.md.

    python scripts/tracing_sweep.py [--null 100] [--results benchmarks/tracing.jsonl] [--page-only] [--from-end]
    python scripts/tracing_sweep.py --only esc_rate_limit --again
    python scripts/tracing_sweep.py --null 10 --seed 98000 --results benchmarks/tracing-98000.jsonl

The drones are those of an independent simulator (cfb_mjx.reference_simulator), whose effects have other functional
forms than the catalogue's; the search was not tuned on them. Results are stored after every campaign, so an interrupted
sweep continues. Files benchmarks/tracing-SEED.jsonl are sweeps on other seeds, which the page summarises.
"""

import argparse
import json
import time
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np
from campaign import facts_line
from tracing_cases import LEAST, MOST, SEED, achievable, alone, cases

from cfb_mjx.files import write_text
from cfb_mjx.parameters import load_model_file
from cfb_mjx.reference_simulator import Case, fly_campaigns, label
from cfb_mjx.runtime import configure_jax, environment
from cfb_mjx.sysid.tracing.jointly import ERRORS

ROOT = Path(__file__).resolve().parents[1]

RESULTS = ROOT / "benchmarks" / "tracing.jsonl"
NULLS = 100
BATCH = 8
MATTERS = 0.05
"""Of many simultaneous effects, those that alone cause at least this share of an error must be found."""


def run(wanted: list[Case], results: Path, from_end: bool, again: bool) -> None:
    """Run the campaigns and append one line each; with ``again``, also those that are done."""
    import jax

    from cfb_mjx.model import Quadrotor
    from cfb_mjx.sysid.evaluation import evaluate
    from cfb_mjx.sysid.tracing.closing import close_loop

    base = load_model_file("cfb-guards")
    declared = Quadrotor.from_file(base)
    while True:
        # Read the file again, because another process may work from the other end.
        done = traced(results, again)
        rest = [case for case in wanted if case.name not in done]
        batch = rest[-BATCH:] if from_end else rest[:BATCH]
        if not batch:
            return
        # The declared model's errors on the same flights without the effect are those of a perfect model.
        twins = [Case(case.name, case.seed, ()) for case in batch if case.effects]
        flown = fly_campaigns(batch + twins)
        perfect = {c.case.name: c for c in flown[len(batch) :]}
        for campaign in flown[: len(batch)]:
            if campaign.case.name in traced(results, again):
                continue
            # Compiled programs would accumulate until the process can map no more memory; they are cached on disk.
            jax.clear_caches()
            began = time.perf_counter()
            outcome = close_loop(campaign.fit, campaign.held_out, base)
            seconds = time.perf_counter() - began
            line = {
                "name": campaign.case.name,
                "labels": [label(name) for name, _ in campaign.case.effects],
                "strengths": [strength for _, strength in campaign.case.effects],
                "found": [item.to_json() for item in outcome.reported],
                "unexplained": outcome.unexplained and outcome.unexplained.formulas,
                "before": _pick(outcome.before.metrics("commands_in")),
                "after": _pick(outcome.after.metrics("commands_in")),
                "seconds": seconds,
                "again": again,
                "environment": environment(),
            }
            if campaign.case.name in perfect:
                twin = evaluate(declared, perfect[campaign.case.name].held_out)
                line["perfect"] = _pick(twin.metrics("commands_in"))
                if _many(line):
                    each = alone(campaign.case)
                    ones = [evaluate(declared, one.held_out) for one in fly_campaigns(list(each.values()))]
                    before = [_pick(one.metrics("commands_in")) for one in ones]
                    line["alone"] = {n: achievable(b, line["perfect"]) for n, b in zip(each, before, strict=True)}
            if campaign.case.name in traced(results, again):  # done by another process in the meantime
                continue
            with results.open("a") as file:
                file.write(json.dumps(line, default=float) + "\n")
            names = [item.name for item in outcome.reported]
            print(f"{campaign.case.name}: {names} unexplained={bool(outcome.unexplained)} {seconds:.0f} s", flush=True)


def traced(results: Path, again: bool) -> set[str]:
    """Return the names of the campaigns that are done, or with ``again`` of those done again."""
    return {line["name"] for line in read(results) if line.get("again") or not again}


def read(results: Path) -> list[dict]:
    """Return one result per campaign, the last one if it ran several times."""
    lines = [json.loads(line) for line in results.read_text().splitlines()] if results.exists() else []
    return list({line["name"]: line for line in lines}.values())


def _pick(metrics: dict) -> dict:
    return {key: metrics[key] for key in ERRORS}


def recovered(line: dict) -> float:
    """Return the reached share of the achievable improvement, mean over errors that it lowers by a tenth or more."""
    shares = [
        (line["before"][key] - line["after"][key]) / (line["before"][key] - line["perfect"][key])
        for key in ERRORS
        if line["perfect"][key] < 0.9 * line["before"][key]
    ]
    return float(np.mean(np.minimum(shares, 1.0))) if shares else float("nan")


def _known(line: dict) -> bool:
    return "environment" in line


def _measured(lines: list[dict]) -> str:
    """Say when and on which machine the campaigns were traced, as far as their results tell."""
    command, known = "python scripts/tracing_sweep.py", [line for line in lines if _known(line)]
    text = facts_line(command, known, "traced") if known else f"Written by `{command}`; do not edit."
    untold = len(lines) - len(known)
    return text + (f" The results of {untold} campaigns do not tell their date and machine." if untold else "")


def page(results: Path, planned: int, again: dict[str, Path]) -> str:
    """Return the page, from the results of ``planned`` campaigns and of sweeps on other seeds (``again``)."""
    lines = read(results)
    _, outside, single, mixed = _sorts(lines)
    text = [
        "# Tracing on the reference simulator",
        "",
        _measured(lines),
        "",
        "This page says how often `cfb close-loop` names the right effect, and how much of the error it removes. Read",
        "it to judge how far you can trust a report. To measure it again (this takes hours):",
        "",
        "```sh",
        "python scripts/tracing_sweep.py",
        "```",
        "",
        f"All {planned} campaigns of the sweep have been traced."
        if len(lines) == planned
        else f"{len(lines)} of {planned} campaigns of the sweep have been traced so far, in random order; the command "
        "continues with the rest.",
        *_traced_by(lines),
        *_traced_again(lines),
        "",
        "A campaign is 10 to 11 flights of one drone in an independent simulator (`cfb_mjx.reference_simulator`,",
        "NumPy, with feedback control). The simulator's effects have other functional forms than the catalogue's, and",
        "the search was developed on other seeds.",
        "",
        "| term | meaning |",
        "|---|---|",
        "| strong, weak | strength 1, strength 0.35 |",
        "| strongest right | the first effect of the report is present |",
        "| every effect found | all effects that are present are reported; of six to twelve effects those that alone "
        f"buy {MATTERS:.0%} or more |",
        "| wrong names | reported effects that are not present |",
        "| buys | largest share by which a perfect model would lower one of eight held-out errors (position, velocity, "
        "attitude, rate; 0.2 and 0.5 s), measured on the same flights flown without the effect |",
        "| recovered | share of that improvement that the corrected model reaches, mean over the errors that a perfect "
        "model would lower by a tenth or more; nan: there is none |",
        "",
        *_summary(lines),
        *_of_many(lines),
        "",
        "## Single effects",
        "",
        "| effect | strength | buys | found | recovered | unexplained |",
        "|---|---|---|---|---|---|",
    ]
    for line in sorted(single + outside, key=lambda x: (x["labels"][0], -x["strengths"][0], x["name"])):
        text.append(_detail(line, line["labels"][0] if line not in outside else line["name"]))
    text += [
        "",
        "## Mixtures",
        "",
        "| effects | strengths | buys | found | recovered | unexplained |",
        "|---|---|---|---|---|---|",
    ]
    text += [_detail(line, ", ".join(line["labels"])) for line in mixed if not _many(line)]
    text += ["", "## Confusion matrix (single effects)", "", *_confusion(single)]
    for seed, path in again.items():
        lines = read(path)
        text += ["", f"## Second sweep: {len(lines)} campaigns on seed {seed}", ""]
        text += [
            "These campaigns were traced after those above with the same configuration. Their failures may have led to",
            "changes since (CHANGELOG.md). They are not traced again: a change must not be judged by the cases it was",
            "made for.",
            "",
            *_summary(lines),
        ]
        text += ["", "Campaigns with a wrong result:", ""]
        text += ["| campaign | strengths | buys | found | recovered | unexplained |"]
        text += ["|---|---|---|---|---|---|", *(_detail(x, x["name"]) for x in lines if not _right(x))]
    return "\n".join([*text, ""])


def _traced_by(lines: list[dict]) -> list[str]:
    """Say how many campaigns each version of the library ran."""
    counts = Counter(line["environment"]["cfb_mjx"] if _known(line) else line.get("version", "0.1.0") for line in lines)
    told = ", ".join(f"cfb_mjx {version}: {count}" for version, count in sorted(counts.items()))
    return [f"Campaigns by version: {told}."]


def _traced_again(lines: list[dict]) -> list[str]:
    names = sorted(line["name"] for line in lines if line.get("again"))
    return [f"Traced again after a change of the search (CHANGELOG.md): {', '.join(names)}."] if names else []


def _sorts(lines: list[dict]) -> tuple[list[dict], list[dict], list[dict], list[dict]]:
    """Sort campaigns: clean drones, effects outside the catalogue, single effects, several effects."""
    outside = [line for line in lines if "outside" in line["labels"]]
    single = [line for line in lines if len(line["labels"]) == 1 and line not in outside]
    return [x for x in lines if not x["labels"]], outside, single, [x for x in lines if len(x["labels"]) > 1]


def _right(line: dict) -> bool:
    """Whether exactly the effects that are present were found."""
    outside = line["labels"] == ["outside"]
    names = {item["name"] for item in line["found"]}
    if _many(line):
        return _expected(line) <= names <= set(line["labels"]) and line["unexplained"] is None
    return names == (set() if outside else set(line["labels"])) and (line["unexplained"] is not None) == outside


def _summary(lines: list[dict]) -> list[str]:
    """Return the table of how often the search was right, by kind of campaign."""
    clean, outside, single, mixed = _sorts(lines)
    text = [
        "| kind | campaigns | strongest right | every effect found | wrong names | recovered, mean | median | least |",
        "|---|---|---|---|---|---|---|---|",
    ]
    groups = {
        "one strong effect": [x for x in single if x["name"].endswith("-strong") and not _sensor(x)],
        "one weak effect": [x for x in single if x["name"].endswith("-weak") and not _sensor(x)],
        "sensor fault, strong": [x for x in single if x["name"].endswith("-strong") and _sensor(x)],
        "sensor fault, weak": [x for x in single if x["name"].endswith("-weak") and _sensor(x)],
        "two or three effects": [x for x in mixed if not _hard(x)],
        f"*hard:* one effect that buys {LEAST:.0%} to {MOST:.0%}": [x for x in single if x["name"].endswith("-mild")],
        "*hard:* a strong effect and weak ones": [x for x in mixed if x["name"].startswith("uneven")],
        "*hard:* sensor fault of 0.6 or 0.8": [x for x in single if x["name"][-2:] in ("-1", "-2")],
        "*hard:* sensor fault and an effect": [x for x in mixed if x["name"].startswith("faulty")],
        "*many:* six to twelve effects": [x for x in mixed if _many(x)],
    }
    for name, group in groups.items():
        if group:
            text.append(f"| {name} | {len(group)} | {_row(group)} |")
    # An empty list of formulas is also a flag: lines in the spectrum that no formula describes.
    wrong = sum(bool(line["found"]) or line["unexplained"] is not None for line in clean)
    flagged = sum(line["unexplained"] is not None for line in outside)
    false_flags = sum(line["unexplained"] is not None for line in single + mixed)
    return [
        *text,
        "",
        f"**Clean drones** (no effect present): {wrong} of {len(clean)} campaigns reported anything.",
        f"**Effects outside the catalogue**: {flagged} of {len(outside)} flagged as unexplained; {false_flags} of "
        f"{len(single + mixed)} campaigns with effects of the catalogue were flagged too.",
        f"**Time**: median {np.median([x['seconds'] for x in lines]):.0f} s per campaign, longest "
        f"{max(x['seconds'] for x in lines):.0f} s.",
    ]


def _hard(line: dict) -> bool:
    return line["name"].startswith(("uneven", "faulty", "many"))


def _many(line: dict) -> bool:
    return line["name"].startswith("many")


def _expected(line: dict) -> set[str]:
    """Return the effects that must be found: all, or of many simultaneous ones those that matter."""
    return {name for name in line["labels"] if line.get("alone", {}).get(name, 1.0) >= MATTERS}


def _of_many(lines: list[dict]) -> list[str]:
    """Return the table of the drones with many effects."""
    many = [line for line in lines if _many(line)]
    if not many:
        return []
    text = [
        "",
        "## Six to twelve effects at once",
        "",
        "Real drones have many effects at once. In brackets: what an effect buys on a drone that has it alone.",
        "",
        "| drone | found | missed | wrong names | recovered | unexplained |",
        "|---|---|---|---|---:|---|",
    ]
    there = found = 0
    for line in sorted(many, key=lambda x: x["name"]):
        names, expected = [item["name"] for item in line["found"]], _expected(line)
        there, found = there + len(expected), found + len(expected & set(names))
        told = [f"{name} ({line['alone'][name]:.0%})" for name in names if name in line["labels"]]
        missed = [f"{name} ({line['alone'][name]:.0%})" for name in line["labels"] if name not in names]
        wrong = [name for name in names if name not in line["labels"]]
        cells = [line["name"], *(", ".join(each) or "-" for each in (told, missed, wrong))]
        flag = "" if line["unexplained"] is None else "yes"
        text.append(f"| {' | '.join(cells)} | {recovered(line):.2f} | {flag} |")
    said = f"Of {there} effects that buy {MATTERS:.0%} or more, {found} were found ({found / there:.0%})."
    return [*text[:4], said, *text[4:]]


def _sensor(line: dict) -> bool:
    return line["labels"][0].startswith("sensor_")


def _row(group: list[dict]) -> str:
    names = [[item["name"] for item in line["found"]] for line in group]
    strongest = [bool(n) and _strongest(line)["name"] in line["labels"] for n, line in zip(names, group, strict=True)]
    every = [_expected(line) <= set(n) for n, line in zip(names, group, strict=True)]
    wrong = sum(len(set(n) - set(line["labels"])) for n, line in zip(names, group, strict=True))
    shares = [recovered(line) for line in group]
    return (
        f"{sum(strongest)} ({np.mean(strongest):.0%}) | {sum(every)} ({np.mean(every):.0%}) | {wrong} | "
        f"{np.nanmean(shares):.3f} | {np.nanmedian(shares):.3f} | {np.nanmin(shares):.3f}"
    )


def _strongest(line: dict) -> dict:
    return line["found"][0]


def _detail(line: dict, what: str) -> str:
    found = ", ".join(item["name"] for item in line["found"]) or "-"
    strengths = ", ".join(f"{s:g}" for s in line["strengths"])
    flag = "" if line["unexplained"] is None else "yes" if line["unexplained"] else "yes, lines in the spectrum"
    buys = achievable(line["before"], line["perfect"])
    return f"| {what} | {strengths} | {buys:.0%} | {found} | {recovered(line):.2f} | {flag} |"


def _confusion(single: list[dict]) -> list[str]:
    table: dict[str, Counter] = defaultdict(Counter)
    for line in single:
        table[line["labels"][0]][_strongest(line)["name"] if line["found"] else "nothing"] += 1
    columns = sorted({name for row in table.values() for name in row})
    out = ["| present \\ reported first | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]
    out += [
        f"| {name} | " + " | ".join(str(row[c] or "") for c in columns) + " |" for name, row in sorted(table.items())
    ]
    return out


def main() -> None:
    """Run the missing campaigns, then write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--null", type=int, default=NULLS)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--only", default="", help="only campaigns whose name contains this")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument(
        "--again", action="store_true", help="also repeat campaigns that are done, after a change of the search"
    )
    parser.add_argument("--page-only", action="store_true")
    parser.add_argument(
        "--from-end", action="store_true", help="start from the other end, so that two processes share a sweep"
    )
    arguments = parser.parse_args()
    configure_jax(x64=True)
    planned = cases(arguments.null, arguments.seed)
    if not arguments.page_only:
        wanted = [case for case in planned if arguments.only in case.name]
        run(wanted, arguments.results, arguments.from_end, arguments.again)
    if arguments.results.resolve() != RESULTS:
        planned = cases(NULLS, SEED)
    again = {path.stem.removeprefix("tracing-"): path for path in sorted(RESULTS.parent.glob("tracing-*.jsonl"))}
    write_text(ROOT / "docs" / "tracing.md", page(RESULTS, len(planned), again))


if __name__ == "__main__":
    main()
