"""``cfb bench``: throughput beside the peers, from one run on one machine."""

from __future__ import annotations

import os
import subprocess
import tempfile
from pathlib import Path

import jax

from cfb_mjx.cli import workloads
from cfb_mjx.cli.first_call import first_call
from cfb_mjx.cli.runtime import configure_jax, environment
from cfb_mjx.cli.scaling import scaling
from cfb_mjx.cli.timed_process import TimedProcess
from cfb_mjx.devices import Devices
from cfb_mjx.errors import CfbError
from cfb_mjx.files import require_folder, write_json, write_text
from cfb_mjx.model.acceleration import kernel_is_chosen


class Peer(TimedProcess):
    """A crazyflow process that times one run per request, so that its runs can alternate with ours."""

    name = "crazyflow"

    def __init__(self, python: Path, drones: int, network: Path | None = None):
        script = Path(__file__).with_name("peers") / "crazyflow_peer.py"
        try:
            self.process = subprocess.Popen(
                [str(python), str(script), str(drones), *([] if network is None else [str(network)])],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                # As its users run it: without the compiler options the cfb command gives itself.
                env={key: value for key, value in os.environ.items() if key != "XLA_FLAGS"},
            )
        except OSError as error:
            raise CfbError(f"--peer-python {python}: cannot be run ({error.strerror}).") from None
        answer = self.process.stdout.readline().split()
        if len(answer) != 4 or answer[0] != "ready":
            last = (self.process.communicate()[1].strip().splitlines() or ["no output"])[-1]
            raise CfbError(f"--peer-python {python}: crazyflow does not run there ({last}).")
        self.version, self.compile_s, self.steps, self.drones = answer[1], float(answer[2]), int(answer[3]), drones
        self.what = "rollout" if network is None else "rollout_policy"


def run_bench(
    drones: list[int],
    json: Path | None,
    markdown: Path | None,
    peer_python: Path | None,
    quick: bool,
    roofline: bool = False,
):
    """Measure, print, write.

    Raises:
        CfbError: impossible batch sizes, no such peer, outputs that cannot be written.
    """
    if not drones or min(drones) < 1:
        raise CfbError("--drones must be whole numbers from 1.")
    require_folder(json, markdown)
    # A CPU shows itself as one device per core, where the backend has not started yet.
    configure_jax(x64=False, devices=len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1)
    # A program from the cache would make compile time look like nothing.
    jax.config.update("jax_enable_compilation_cache", False)
    repetitions, over = 2 if quick else 7, Devices.take(jax.local_device_count())
    rows, peers = [], []
    print(f"{'what':<20}{'body':<18}{'drones':>7}{'steps/s':>12}{'compile s':>11}{'memory MB':>11}")
    for count in drones:
        group = [workloads.rollout(count), workloads.rollout_randomised(count)]
        group += [workloads.rollout(count, "rigid-plain")] if kernel_is_chosen() else []
        peer = Peer(peer_python, count) if peer_python is not None else None
        group += [peer] if peer else []
        several = over.several and count >= 64 and count % over.count == 0
        group += [workloads.rollout(count, over=over)] if several else []
        times = _alternate(group, repetitions)
        if not quick:
            slow = [workloads.rollout(count, "mjx"), workloads.rollout(count, "mjx-floor"), workloads.stock_mjx(count)]
            slow.append(workloads.rollout_policy(count))
            slow += [workloads.rollout_policy(count, over)] if several else []
            if peer:
                with tempfile.TemporaryDirectory() as folder:
                    slow.append(Peer(peer_python, count, workloads.network_file(Path(folder))))
            if count <= 8192:
                slow += [workloads.rollout_gradient(count), workloads.rollout_ten(count)]
                slow.append(workloads.rollout_hundred(count))
            times += _alternate(slow, 5)
            group += slow
        for item, seconds in zip(group, times, strict=True):
            if isinstance(item, Peer):
                peers.append(
                    {"name": item.name, "version": item.version, "what": item.what, "drones": count}
                    | {"steps_per_s": count * item.steps / seconds, "compile_s": item.compile_s}
                )
                print(
                    f"{item.what:<20}{item.name:<18}{count:>7}{peers[-1]['steps_per_s']:>12.3g}{item.compile_s:>11.2f}"
                )
                item.close()
                continue
            row = {"what": item.what, "body": item.body, "drones": count, "steps_per_s": count * item.steps / seconds}
            row |= {"compile_s": item.compile_s, "peak_mb": item.peak_mb}
            rows.append(row)
            print(
                f"{item.what:<20}{item.body:<18}{count:>7}{row['steps_per_s']:>12.3g}"
                f"{item.compile_s:>11.2f}{item.peak_mb:>11.1f}",
                flush=True,
            )
    result = {"rows": rows, "peers": peers, "environment": environment()}
    result |= {"first_call": first_call()} | ({} if quick else {"scaling": scaling()})
    if roofline:
        from cfb_mjx.cli.roofline import roofline as measure
        from cfb_mjx.cli.roofline import section

        result["roofline"] = measure()
        print(section(result["roofline"]))
    for line in ratios(result):
        print(line)
    if json is not None:
        write_json(json, result)
    if markdown is not None:
        write_text(markdown, page(result))


def _alternate(items: list, repetitions: int) -> list[float]:
    """Best time of each; the runs take turns, so that a busy moment of the machine hits all of them."""
    best = [float("inf")] * len(items)
    for _ in range(repetitions):
        for index, item in enumerate(items):
            best[index] = min(best[index], item.seconds())
    return best


def _speed(result: dict, what: str, body: str, drones: int) -> float | None:
    for row in result["rows"]:
        if (row["what"], row["body"], row["drones"]) == (what, body, drones):
            return row["steps_per_s"]
    return None


def _on_devices(result: dict, what: str, drones: int) -> list[tuple[int, float]]:
    """Number of devices and speed of every row that was measured on several."""
    return [
        (int(row["body"].split()[1]), row["steps_per_s"])
        for row in result["rows"]
        if (row["what"], row["drones"]) == (what, drones) and row["body"].startswith("rigid, ")
    ]


def ratios(result: dict) -> list[str]:
    """Side-by-side sentences for every batch size."""
    lines = []
    for drones in sorted({row["drones"] for row in result["rows"]}):
        ours = _speed(result, "rollout", "rigid", drones)
        for peer in result["peers"]:
            if peer["drones"] == drones:
                speed = _speed(result, peer["what"], "rigid", drones) / peer["steps_per_s"]
                what = "closed form" if peer["what"] == "rollout" else "the same network in the loop"
                line = f"{drones} drones: {what} {speed:.1f} x {peer['name']} {peer['version']}"
                for n, several in _on_devices(result, peer["what"], drones):
                    line += f"; on {n} devices {several / peer['steps_per_s']:.1f} x"
                lines.append(line)
        if ten := _speed(result, "rollout_ten", "rigid", drones):
            forward = _speed(result, "rollout_hundred", "rigid", drones)
            lines.append(f"{drones} drones: a gradient by ten parameters costs {forward / ten:.1f} x the same rollout")
        if plain := _speed(result, "rollout", "rigid-plain", drones):
            lines.append(f"{drones} drones: the kernel {ours / plain:.2f} x the plain program")
        free, floor, stock = (_speed(result, "rollout", b, drones) for b in ("mjx", "mjx-floor", "mjx-stock"))
        if free and floor and stock:
            lines.append(f"{drones} drones: MJX without floor {free / stock:.2f} x stock mjx.step")
            lines.append(f"{drones} drones: MJX without floor {free / floor:.1f} x MJX with floor")
    return lines


def page(result: dict) -> str:
    """The results as a Markdown page."""
    facts = ", ".join(f"{name} {value}" for name, value in result["environment"].items())
    table = ["| what | body | drones | steps/s | compile, s | memory, MB |", "|---|---|---:|---:|---:|---:|"]
    for row in result["rows"]:
        table.append(
            f"| {row['what']} | {row['body']} | {row['drones']} | {row['steps_per_s']:.3g} "
            f"| {row['compile_s']:.2f} | {row['peak_mb']:.1f} |"
        )
    for peer in result["peers"]:
        name = f"{peer['name']} {peer['version']}"
        table.append(
            f"| {peer['what']} | {name} | {peer['drones']} | {peer['steps_per_s']:.3g} | {peer['compile_s']:.2f} | |"
        )
    from cfb_mjx.cli.roofline import section

    gpu = "" if jax.default_backend() != "cpu" else "GPU: not measured (none on this machine).\n"
    comparison = "\n".join(f"- {line}" for line in ratios(result))
    return f"""# Performance

Written by `make bench` (`cfb bench --peer-python ... --markdown docs/performance.md`); do not edit.

{facts}

Steps per second of all drones together, float32; the best of several runs that take turns with the peer's.
`rollout`: open loop, {workloads.STEPS} steps of 4 ms (MJX fewer), one command held per drone, final state only.
`rollout_randomised`: the same, every drone with its own parameters. `rollout_gradient`: reverse-mode gradient of a
100-step rollout with respect to all parameters, `rollout_ten` with respect to ten, `rollout_hundred` that rollout
alone. `rollout_policy`: the shipped policy `target` in the loop (`rollout_closed_loop`), a command every 8 ms. Bodies:
`rigid` closed form, on one JAX device (which is one core) or several; `mjx` MuJoCo XLA without contact;
`mjx-floor` with floor contact; `mjx-stock` plain `mjx.step` on the same MJCF without contact. crazyflow runs
first-principles dynamics under rotor-velocity control at 500 Hz, `sim.step(500)`, and with the same network in its loop
at 250 Hz, a command every 8 ms, in a process with XLA's default options and on the one device it uses; ours runs with
the option the `cfb` command sets for itself on CPU ([model.md](model.md#speed)):
`XLA_FLAGS={os.environ.get("XLA_FLAGS", "")}`.
Memory is the compiled program's arguments, results and temporaries.

{comparison}

{gpu}
{chr(10).join(table)}

{first_call_section(result["first_call"])}
{scaling_section(result.get("scaling"))}
{section(result["roofline"]) if "roofline" in result else ""}"""


def first_call_section(rows: list[dict]) -> str:
    """Markdown."""
    lines = "\n".join(f"| {row['cache']} | {row['import_s']:.1f} | {row['call_s']:.1f} |" for row in rows)
    return f"""## The first call

A new process flies 4096 drones for half a second, as the `cfb` command would: loading the library, and from there to
the result. The cache of compiled programs is on by default, in the user's cache folder.

| cache | loading, s | first call, s |
|---|---:|---:|
{lines}
"""


def scaling_section(rows: list[dict] | None) -> str:
    """Markdown; nothing where it was not measured."""
    if not rows:
        return ""
    lines = "\n".join(
        f"| {row['what']} | {row['drones']} | {row['devices']} | {row['steps_per_s']:.3g} | {row['ratio']:.2f} |"
        for row in rows
    )
    return f"""## From one core to two

One device in a process bound to one core, and two devices in one bound to two; the runs take turns, the best counts.
`ppo`: one update with the shipped configuration.

| what | drones | devices | steps/s | times one |
|---|---:|---:|---:|---:|
{lines}
"""
