"""Trace drones of the reference simulator that nobody tuned to, and write docs/tracing.md: confusion, recovered error.

    python scripts/tracing_sweep.py [--null 100] [--results benchmarks/tracing.jsonl] [--page-only] [--from-end]
    python scripts/tracing_sweep.py --only esc_rate_limit --again
    python scripts/tracing_sweep.py --null 10 --seed 98000 --results benchmarks/tracing-98000.jsonl

The plants (cfb_mjx.reference_simulator) are an independent simulator with effects of other functional forms than the
catalogue's. Results are kept campaign by campaign: an interrupted sweep goes on where it was. What lies beside
benchmarks/tracing.jsonl as tracing-SEED.jsonl is the same on other seeds; the page sums it up.
"""

import argparse
import json
import time
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np
from tracing_cases import LEAST, MOST, SEED, achievable, alone, cases

from cfb_mjx.files import write_text
from cfb_mjx.parameters import load_model_file
from cfb_mjx.reference_simulator import Case, fly_campaigns, label
from cfb_mjx.runtime import configure_jax, environment
from cfb_mjx.sysid.tracing.fits import ERRORS

ROOT = Path(__file__).resolve().parents[1]

RESULTS = ROOT / "benchmarks" / "tracing.jsonl"
NULLS = 100
BATCH = 8
MATTERS = 0.05
"""Of many effects at once those must be found that alone buy so much."""


def run(wanted: list[Case], results: Path, from_end: bool, again: bool) -> None:
    """Fly, trace and append one line per campaign; those traced before too if ``again``."""
    import jax

    from cfb_mjx.model import Quadrotor
    from cfb_mjx.sysid.evaluation import evaluate
    from cfb_mjx.sysid.tracing.closing import close_loop

    base = load_model_file("cfb-guards")
    declared = Quadrotor.from_file(base)
    while True:
        # Read anew: another process may be at the other end.
        done = traced(results, again)
        rest = [case for case in wanted if case.name not in done]
        batch = rest[-BATCH:] if from_end else rest[:BATCH]
        if not batch:
            return
        # The same flights without the effect: what the declared model scores there, a perfect one would score here.
        twins = [Case(case.name, case.seed, ()) for case in batch if case.effects]
        flown = fly_campaigns(batch + twins)
        perfect = {c.case.name: c for c in flown[len(batch) :]}
        for campaign in flown[: len(batch)]:
            if campaign.case.name in traced(results, again):
                continue
            # Programs of every shape met would pile up until the process may map no more memory; they are kept on disk.
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
                "version": environment()["cfb_mjx"],
            }
            if campaign.case.name in perfect:
                twin = evaluate(declared, perfect[campaign.case.name].held_out)
                line["perfect"] = _pick(twin.metrics("commands_in"))
                if _many(line):
                    each = alone(campaign.case)
                    ones = [evaluate(declared, one.held_out) for one in fly_campaigns(list(each.values()))]
                    before = [_pick(one.metrics("commands_in")) for one in ones]
                    line["alone"] = {n: achievable(b, line["perfect"]) for n, b in zip(each, before, strict=True)}
            if campaign.case.name in traced(results, again):  # by the other process, meanwhile
                continue
            with results.open("a") as file:
                file.write(json.dumps(line, default=float) + "\n")
            names = [item.name for item in outcome.reported]
            print(f"{campaign.case.name}: {names} unexplained={bool(outcome.unexplained)} {seconds:.0f} s", flush=True)


def traced(results: Path, again: bool) -> set[str]:
    """Names of the campaigns that are done, or done ``again``."""
    return {line["name"] for line in read(results) if line.get("again") or not again}


def read(results: Path) -> list[dict]:
    """One entry per campaign that is done, the last where it was traced again."""
    lines = [json.loads(line) for line in results.read_text().splitlines()] if results.exists() else []
    return list({line["name"]: line for line in lines}.values())


def _pick(metrics: dict) -> dict:
    return {key: metrics[key] for key in ERRORS}


def recovered(line: dict) -> float:
    """Share of the achievable improvement reached, mean over errors a perfect model lowers by a tenth or more."""
    shares = [
        (line["before"][key] - line["after"][key]) / (line["before"][key] - line["perfect"][key])
        for key in ERRORS
        if line["perfect"][key] < 0.9 * line["before"][key]
    ]
    return float(np.mean(np.minimum(shares, 1.0))) if shares else float("nan")


def page(results: Path, planned: int, again: dict[str, Path]) -> str:
    """The page, from the results of so many planned campaigns, and those of other seeds."""
    lines = read(results)
    _, outside, single, mixed = _sorts(lines)
    text = [
        "# Tracing on the reference simulator",
        "",
        "Written by `python scripts/tracing_sweep.py`; do not edit. "
        + ", ".join(f"{name} {value}" for name, value in environment().items()),
        "",
        f"All {planned} campaigns of the sweep have been traced."
        if len(lines) == planned
        else f"{len(lines)} of {planned} campaigns of the sweep have been traced so far, in an order of no meaning; "
        "the command goes on with the rest.",
        *_traced_by(lines),
        *_traced_again(lines),
        "",
        "Campaigns of 10 to 11 flights by an independent simulator (`cfb_mjx.reference_simulator`, NumPy, closed loop)",
        "whose effects have other functional forms than the catalogue's. The search was developed on other seeds.",
        "*Buys* is the largest share by which a perfect model would lower one of eight held-out errors (position,",
        "velocity, attitude, rate; 0.2 and 0.5 s), measured on the same flights flown without the effect; *recovered*",
        "is the share of that improvement the corrected model reaches.",
        "",
        *_summary(lines),
        *_of_many(lines),
        "",
        "## What was found for what was there (single effects)",
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
    text += ["", "## Confusion (strong and weak single effects)", "", *_confusion(single)]
    for seed, path in again.items():
        lines = read(path)
        text += ["", f"## Again: {len(lines)} campaigns on seed {seed}", ""]
        text += [
            "Traced after the above by the same configuration. What is not as it should be there may have led to",
            "changes since (CHANGELOG.md); it is not traced anew, for a change is not judged by what it was made for.",
            "",
            *_summary(lines),
        ]
        text += ["", "Not as it should be there:", "", "| there | strengths | buys | found | recovered | unexplained |"]
        text += ["|---|---|---|---|---|---|", *(_detail(x, x["name"]) for x in lines if not _right(x))]
    return "\n".join([*text, ""])


def _traced_by(lines: list[dict]) -> list[str]:
    """Which versions of the search traced how many."""
    counts = Counter(line.get("version", "0.1.0") for line in lines)
    return ["Traced by " + ", ".join(f"cfb_mjx {version}: {count}" for version, count in sorted(counts.items())) + "."]


def _traced_again(lines: list[dict]) -> list[str]:
    names = sorted(line["name"] for line in lines if line.get("again"))
    return [f"Once more after a change of the search (CHANGELOG.md): {', '.join(names)}."] if names else []


def _sorts(lines: list[dict]) -> tuple[list[dict], list[dict], list[dict], list[dict]]:
    """Campaigns of clean drones, of what the catalogue lacks, of one effect and of more."""
    outside = [line for line in lines if "outside" in line["labels"]]
    single = [line for line in lines if len(line["labels"]) == 1 and line not in outside]
    return [x for x in lines if not x["labels"]], outside, single, [x for x in lines if len(x["labels"]) > 1]


def _right(line: dict) -> bool:
    """Whether all that was there was found, and nothing else."""
    outside = line["labels"] == ["outside"]
    names = {item["name"] for item in line["found"]}
    if _many(line):
        return _expected(line) <= names <= set(line["labels"]) and line["unexplained"] is None
    return names == (set() if outside else set(line["labels"])) and (line["unexplained"] is not None) == outside


def _summary(lines: list[dict]) -> list[str]:
    """How often the search was right, kind by kind."""
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
    # An empty list of formulas is a flag too: lines in the spectrum no formula describes.
    wrong = sum(bool(line["found"]) or line["unexplained"] is not None for line in clean)
    flagged = sum(line["unexplained"] is not None for line in outside)
    false_flags = sum(line["unexplained"] is not None for line in single + mixed)
    return [
        *text,
        "",
        f"**Clean drones**: {wrong} of {len(clean)} campaigns reported anything.",
        f"**Outside the catalogue**: {flagged} of {len(outside)} flagged as unexplained; {false_flags} of "
        f"{len(single + mixed)} campaigns with effects of the catalogue were flagged too.",
        f"**Time**: median {np.median([x['seconds'] for x in lines]):.0f} s a campaign, longest "
        f"{max(x['seconds'] for x in lines):.0f} s.",
    ]


def _hard(line: dict) -> bool:
    return line["name"].startswith(("uneven", "faulty", "many"))


def _many(line: dict) -> bool:
    return line["name"].startswith("many")


def _expected(line: dict) -> set[str]:
    """What must be found: everything there, of many effects what matters."""
    return {name for name in line["labels"] if line.get("alone", {}).get(name, 1.0) >= MATTERS}


def _of_many(lines: list[dict]) -> list[str]:
    """Drones with many effects, one by one."""
    many = [line for line in lines if _many(line)]
    if not many:
        return []
    text = [
        "",
        "## Six to twelve effects at once",
        "",
        "As real drones have them. In brackets what an effect buys on a drone that has it alone.",
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
    out = ["| there \\ strongest reported | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]
    out += [
        f"| {name} | " + " | ".join(str(row[c] or "") for c in columns) + " |" for name, row in sorted(table.items())
    ]
    return out


def main() -> None:
    """Run what is missing, then write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--null", type=int, default=NULLS)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--only", default="", help="campaigns whose name contains this")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--again", action="store_true", help="after a change: also those that are done, once more")
    parser.add_argument("--page-only", action="store_true")
    parser.add_argument("--from-end", action="store_true", help="begin at the other end: two processes share a sweep")
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
