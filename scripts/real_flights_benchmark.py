"""The section of docs/closing-real-flights.md on the nano-drone benchmark, from what `close_real_flights` measured."""

from cfb_mjx.sysid.nanodrone import PUBLISHED

GOAL = (1.91, 8.86, 3.94, 20.8)
"""What the project set itself on the benchmark's test flights, as the sums of `PUBLISHED`."""
FORECASTS = ("predictor", "predictor, observer")
HEAD = ("| | position | velocity | attitude | body rate |", "|---|---|---|---|---|")


def benchmark_section(results: dict) -> list[str]:
    """Its lines; ``results`` has the sums under ``sums`` and ``unseen``."""
    elsewhere = PUBLISHED | {"goal": GOAL}
    return [
        "## The nano-drone benchmark on these flights",
        "",
        "Sums of mean errors over 50 steps of 10 ms, rotor speeds in ([rules](nanodrone.md)): position m, velocity",
        "m/s, attitude rad, body rate rad/s, and beside each its share of the rows *naive* and *physics*.",
        "Published rows are on the benchmark's own test flights, which are easier to predict from how the drone",
        "moves: *physics*, one and the same rule, errs a smaller share of *naive* there. Compare shares of both.",
        "",
        *HEAD,
        *_rows(results["sums"]["together"]),
        *_rows(elsewhere, "on those: "),
        "",
        *_verdict(results["sums"]["together"]),
        "",
        "Flight by flight, physics and the predictor with observer, beside the published *physics* and the goal:",
        "",
        *HEAD,
        *_by_flight(results["sums"]),
        *_rows(elsewhere, "on those: ", ("physics", "goal")),
        "",
        "Does it carry over to references it was not fitted to? The predictor fitted again without flights of the kind",
        "of reference it is judged on (the observer's levels left as they are):",
        "",
        *HEAD,
        *(line for kind, rows in results["unseen"].items() for line in _rows(rows, f"{kind}, unseen: ", FORECASTS)),
    ]


def _verdict(sums: dict[str, list[float]]) -> list[str]:
    """Which of the goal's shares the predictor reaches."""
    lines = []
    for row in FORECASTS:
        reached = {
            name: [x / a <= g / b for x, a, g, b in zip(sums[row], sums[name], GOAL, PUBLISHED[name], strict=True)]
            for name in ("naive", "physics")
        }
        text = " and ".join(f"{sum(found)} of {len(found)} shares of *{name}*" for name, found in reached.items())
        lines.append(f"Of the goal's shares the row *{row}* reaches {text}.")
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
