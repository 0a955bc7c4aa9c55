"""The section of docs/closing-real-flights.md on the nano-drone benchmark, from results of `close_real_flights`."""

from cfb_mjx.sysid.nanodrone import PUBLISHED

GOAL = (1.91, 8.86, 3.94, 20.8)
"""Goal of the project on the benchmark's test flights, as the sums in `PUBLISHED`."""
FORECASTS = ("predictor", "predictor, observer")
HEAD = ("| | position | velocity | attitude | body rate |", "|---|---|---|---|---|")


def benchmark_section(results: dict) -> list[str]:
    """Return the lines of the section; ``results`` has the sums under ``sums`` and ``unseen``."""
    elsewhere = PUBLISHED | {"goal": GOAL}
    return [
        "## The nano-drone benchmark on these flights",
        "",
        "The table gives sums of mean errors over 50 steps of 10 ms, rotor speeds in ([rules](nanodrone.md)): position",
        "m, velocity m/s, attitude rad, body rate rad/s. In brackets is the ratio to the row *naive* / to the row",
        "*physics* of the same flights.",
        "",
        "Rows that begin with *test flights* are published results, and the project's goal, on the benchmark's own",
        "test flights. Those are easier to predict from the motion of the drone: *physics*, the same rule on both, has",
        "a smaller ratio to *naive* there. Compare both ratios.",
        "",
        *HEAD,
        *_rows(results["sums"]["together"]),
        *_rows(elsewhere, "test flights: "),
        "",
        *_verdict(results["sums"]["together"]),
        "",
        "Flight by flight, *physics* and the predictor with observer, with the published *physics* and the goal:",
        "",
        *HEAD,
        *_by_flight(results["sums"]),
        *_rows(elsewhere, "test flights: ", ("physics", "goal")),
        "",
        "To test references that the predictor was not fitted to, it was fitted again without flights of the kind of",
        "reference that it is judged on (the observer's levels stay as they are):",
        "",
        *HEAD,
        *(line for kind, rows in results["unseen"].items() for line in _rows(rows, f"{kind}, unseen: ", FORECASTS)),
    ]


def _verdict(sums: dict[str, list[float]]) -> list[str]:
    """Say in how many ratios the predictor reaches the goal."""
    lines = []
    for row in FORECASTS:
        reached = {
            name: [x / a <= g / b for x, a, g, b in zip(sums[row], sums[name], GOAL, PUBLISHED[name], strict=True)]
            for name in ("naive", "physics")
        }
        text = " and ".join(f"{sum(found)} of {len(found)} ratios to *{name}*" for name, found in reached.items())
        lines.append(f"The row *{row}* reaches the goal in {text}.")
    return lines


def _by_flight(sums: dict[str, dict]) -> list[str]:
    flights = {name: rows for name, rows in sums.items() if name != "together"}
    return [
        line for name, rows in flights.items() for line in _rows(rows, f"{name}: ", ("physics", "predictor, observer"))
    ]


def _rows(rows: dict, prefix: str = "", chosen: tuple[str, ...] | None = None) -> list[str]:
    shares = list(zip(rows["naive"], rows["physics"], strict=True))
    return [
        f"| {prefix}{name} | "
        + " | ".join(f"{x:.3g} ({x / n:.2f} / {x / p:.2f})" for x, (n, p) in zip(row, shares, strict=True))
        + " |"
        for name, row in rows.items()
        if chosen is None or name in chosen
    ]
