"""Export a policy as a folder of C: fixed sources, and generated weights and settings."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cfb_mjx import __version__
from cfb_mjx.control.policy_file import PolicyFile
from cfb_mjx.deploy.contract import BLIND_STEPS, FROZEN_STEPS, LARGEST, contract
from cfb_mjx.deploy.deployment import CATCH_S, Deployment
from cfb_mjx.deploy.weights import FILE, HEADER, weight_arrays, weight_set
from cfb_mjx.files import output_folder, plain, remove, replacing, together, write_texts
from cfb_mjx.optional import not_none

FIXED = ("cfb_network.h", "cfb_network.c", "cfb_pilot.h", "cfb_policy.h", "cfb_policy.c", "controller_out_of_tree.c")
BUILD = ("Kbuild", "Makefile", "app-config", "README.md")
LIBRARY = ("cfb_policy.c", "cfb_pilot.c", "cfb_network.c", "cfb_data.c")
"""Sources of the plain library."""
LOADABLE = ("cfb_weights.h", "cfb_weights.c", "load_weights.py")
"""Further files of a policy whose weights can be replaced without flashing."""
PILOTS = {True: "cfb_pilot_flip.c", False: "cfb_pilot_hold.c"}
"""Both are exported under one name, so that no file of an earlier export remains beside a later one."""
RESULTS = "check.json"
"""File that ``cfb export --check`` writes."""
CARD = "card.md"
"""File with the cards of the policies that have one."""
_NEVER = 1e9
"""Stands for a time, speed or angle that is never reached."""


class Exported(NamedTuple):
    """Folder of an export."""

    folder: Path
    deployment: Deployment

    @property
    def sources(self) -> list[Path]:
        """Sources of the plain library."""
        more = [name for name in LOADABLE if name.endswith(".c")] if self.deployment.loadable else []
        return [self.folder / name for name in (*LIBRARY, *more)]


def export_policy(deployment: Deployment, folder: str | Path) -> Exported:
    """Write the C sources, the firmware app and the contract.

    Args:
        deployment: policies to export.
        folder: output folder; created if it does not exist.

    Raises:
        CfbError: the folder cannot be created or written; its earlier contents are unchanged.
    """
    folder = output_folder(folder)
    with together():
        texts = sources(deployment)
        write_texts(folder, texts)
        # These belong to the export that was overwritten.
        for name in {RESULTS, CARD, FILE, *LOADABLE} - {*texts}:
            remove(folder / name)
        if deployment.loadable:
            with replacing(folder / FILE) as temporary:
                temporary.write_bytes(weight_set(deployment))
    return Exported(folder, deployment)


def sources(deployment: Deployment) -> dict[str, str]:
    """Names and contents of all text files of an export."""
    names = (*FIXED, *BUILD, *(LOADABLE if deployment.loadable else ()))
    texts = {name: _filled(_template(name), deployment) for name in names}
    texts["cfb_pilot.c"] = _filled(_template(PILOTS[deployment.flips]), deployment)
    texts["cfb_sizes.h"] = _sizes(deployment)
    texts["cfb_data.h"] = _header(deployment)
    texts["cfb_data.c"] = _data(deployment)
    if cards := _cards(deployment):
        texts[CARD] = cards
    texts["contract.json"] = json.dumps(plain(contract(deployment)), indent=1) + "\n"
    return texts


def _cards(deployment: Deployment) -> str:
    return "\n".join(policy.card for policy in deployment.policies.values() if policy.card)


def _template(name: str) -> str:
    return files("cfb_mjx.deploy").joinpath("c", name).read_text(encoding="utf-8")


def _filled(text: str, deployment: Deployment) -> str:
    """Fill the names into a template, and keep its parts for what this deployment can do (`_abilities`)."""
    kept, dropping, able = [], False, _abilities(deployment)
    for line in text.splitlines():
        if line.startswith("//@"):
            dropping = line != "//@end" and line[3:] not in able
        elif not dropping:
            kept.append(line)
    text = "\n".join(kept) + "\n"
    for mark, value in _marks(deployment).items():
        text = text.replace(f"@{mark}@", value)
    return text


def _abilities(deployment: Deployment) -> set[str]:
    """Parts of the templates that are kept."""
    layout = deployment.holder.controller.layout
    return {
        "flip" if deployment.flips else "no flip",
        "loadable" if deployment.loadable else "fixed",
        "gru" if deployment.holder.controller.recurrent else "no gru",
        "previews" if layout.preview_s else "hold",
        "card" if _cards(deployment) else "no card",
        "motors" if layout.action == "motors" else "loop",
        layout.action,
        "through_pid" if layout.action in ("attitude", "velocity", "position") else "direct",
    }


_C_OUTPUTS = {
    "motors": "of M1..M4, each in [0, 1], proportional to the voltage (duty) at the motor.",
    "body_rates": (
        "mean command of the motors, [0, 1], and body rates about x, y and z, rad/s, for the firmware's rate loop,\n"
        " * with which it was trained."
    ),
    "attitude": "mean command of the motors, [0, 1], and roll, pitch and yaw, rad, right-handed about body x, y and z.",
    "velocity": "velocity, world, m/s, and yaw, rad.",
    "position": "position relative to the target, world, m, and yaw, rad.",
}


_COMMANDS = {
    "motors": "The policy commands the motors itself, with the firmware's controllers bypassed.",
    "body_rates": "The policy commands thrust and body rates; the firmware's rate loop follows them at 500 Hz.",
    "attitude": "The policy commands thrust and attitude; the firmware's PID follows them at 500 Hz.",
    "velocity": "The policy commands velocities; the firmware's PID follows them.",
    "position": "The policy commands positions about the target; the firmware's PID follows them.",
}


_LOGGED = {
    "motors": "The log group `cfb` has the commands, 0 to 1, and the fault.",
    "loop": (
        "The log group `cfb` has the set-points (`set1` to `set4`) and the fault; log the firmware's `motor.m1` to "
        "`motor.m4` too."
    ),
}


def _marks(deployment: Deployment) -> dict[str, str]:
    delay = deployment.pose_delay()
    layout = deployment.holder.controller.layout
    step_ms = 1e3 * layout.control_dt_s
    does = "tracks a target that moves" if layout.preview_s else "flies the drone to a target and holds it there"
    marks = {
        "TITLE": f"{deployment.name}, a policy of a Crazyflie Brushless",
        "WHAT": f"A network that {does}, every {step_ms:g} ms.",
        "VERSION": __version__,
        "HASH": " and ".join(p.weights_sha256[:12] for p in deployment.policies.values()),
        "PILOT_DOES": "what flies: the network",
        "DELAY_MS": "an unknown number of" if delay is None else f"{1e3 * delay:g}",
        "BLIND_STEPS": f"{BLIND_STEPS}",
        "FROZEN_STEPS": f"{FROZEN_STEPS}",
        "FROZEN_MS": f"{FROZEN_STEPS * step_ms:g}",
        "OUTPUTS": f" * {_C_OUTPUTS[layout.action]}",
        "COMMANDS": _COMMANDS[layout.action],
        "LOGGED": _LOGGED["motors" if layout.action == "motors" else "loop"],
        "PREVIEWS": f"{len(layout.preview_s)}",
        "PREVIEWS_S": ", ".join(f"{ahead:g}" for ahead in layout.preview_s),
        "LARGEST_BITS": f"{np.float32(LARGEST).view(np.uint32):#x}",
        "BLIND_MS": f"{BLIND_STEPS * step_ms:g}",
        "FLIP": "",
        "HOLDER": "cfb_weights_network()" if deployment.loadable else "&cfb_holder",
        "HOVER": "cfb_weights_hover()" if deployment.loadable else "hover",
        "MORE_SOURCES": " cfb_weights.c" if deployment.loadable else "",
    }
    if not deployment.flips:
        return marks
    manoeuvre, ranges = not_none(deployment.manoeuvre), deployment.setpoint_ranges
    knobs = manoeuvre.knobs
    times = {1: "once", 2: "twice"}.get(manoeuvre.rotations, f"{manoeuvre.rotations} times")
    flip = f"""
## Flipping

It holds the target until `cfb_policy_set_flip(v_target, rate_target)`, or on the drone until the parameter `cfbflip.go`
is set to 1; then it climbs, turns {times} about its x axis, and is caught at the target. `v_target` may lie between
{ranges["speed_mps"][0]:g} and {ranges["speed_mps"][1]:g} m/s, `rate_target` between {ranges["rate_radps"][0]:g} and \
{ranges["rate_radps"][1]:g} rad/s; the manoeuvre was designed with
{float(knobs.speed_mps):g} m/s and {float(knobs.rate_radps):g} rad/s, and other numbers want other switching times \
(`cfb fly --search`). It was judged with
2 m of air below; see `cfb fly` for what yours needs.
"""
    return marks | {
        "WHAT": f"Holds a target, every {step_ms:g} ms, and on demand turns {times} about the body's x axis.",
        "PILOT_DOES": "what flies: hold, climb, turn, catch",
        "SPEED": literal(knobs.speed_mps),
        "RATE": literal(knobs.rate_radps),
        "FLIP": flip,
    }


def literal(x) -> str:
    """A number as a C literal of single precision that reads back as the same number."""
    value = np.float32(x)
    if not math.isfinite(value):
        value = np.float32(math.copysign(_NEVER, float(value)))
    text = np.format_float_positional(value, unique=True, trim="0") if 1e-4 < abs(value) < 1e6 or value == 0 else None
    return f"{text or np.format_float_scientific(value, unique=True, trim='0')}f"


def _sizes(deployment: Deployment) -> str:
    layouts = [p.controller.layout for p in deployment.policies.values()]
    networks = [p.controller.network for p in deployment.policies.values()]
    outputs = [given for network in networks for _, given in network.sizes]
    estimates = max(1, *(layout.past_estimates for layout in layouts))
    commands = max(1, *(layout.past_commands for layout in layouts))
    setpoints = max(layout.shown for layout in layouts)
    frame = max(layout.frame for layout in layouts)
    numbers = {
        "CFB_FRAME": frame,
        "CFB_KEPT_FRAMES": max(1, *(layout.past_estimates * layout.estimate_stride for layout in layouts)),
        "CFB_KEPT_COMMANDS": commands,
        # Sized for all networks together: a compiler that analyses the loops must not find out-of-bounds writes.
        "CFB_WIDEST": max(frame * (1 + estimates) + 4 * commands + 3 + setpoints, *outputs),
    }
    kept = [network.gru.size for network in networks if network.gru is not None]
    numbers |= {"CFB_HIDDEN": max(kept)} if kept else {}
    lines = "\n".join(f"#define {name} {value}" for name, value in numbers.items())
    return _guarded("CFB_SIZES_H", f"/* Generated for {deployment.name}: what its networks need. */", lines)


def _guarded(mark: str, head: str, body: str) -> str:
    return f"{head}\n#ifndef {mark}\n#define {mark}\n\n{body}\n\n#endif\n"


def _header(deployment: Deployment) -> str:
    values = {
        "CFB_DT_S": literal(deployment.holder.controller.control_dt_s),
        "CFB_HOVER_OUTPUTS": "{" + ", ".join(map(literal, deployment.settled())) + "}",
    }
    layout = deployment.holder.controller.layout
    outputs = deployment.action.outputs
    values |= {
        f"CFB_{end.upper()}": "{" + ", ".join(literal(getattr(each, end)) for each in outputs) + "}"
        for end in ("low", "high")
    }
    if layout.preview_s:
        values["CFB_PREVIEW_TIMES"] = "{" + ", ".join(literal(ahead) for ahead in layout.preview_s) + "}"
    if deployment.flips:
        knobs, ranges = not_none(deployment.manoeuvre).knobs, deployment.setpoint_ranges
        values |= {f"CFB_{name.upper()}": literal(getattr(knobs, name)) for name in knobs._fields[:3]}
        values |= {"CFB_CLIMB_MPS": literal(knobs.climb_mps), "CFB_TURN_RAD": literal(knobs.turn_rad)}
        values |= {"CFB_CATCH_S": literal(CATCH_S)}
        for name, key in (("SPEED", "speed_mps"), ("RATE", "rate_radps")):
            low, high = ranges[key]
            values |= {f"CFB_LEAST_{name}": literal(low), f"CFB_LARGEST_{name}": literal(high)}
    if deployment.loadable:
        names = ("MAGIC", "VERSION", "ARCHITECTURE", "COUNT", "CRC")
        of_set = zip(names, HEADER.unpack_from(weight_set(deployment)), strict=True)
        values |= {f"CFB_SET_{name}": f"{value:#x}u" for name, value in of_set}
    defines = "\n".join(f"#define {name} {value}" for name, value in values.items())
    networks = "\n".join(f"extern const cfb_network_t cfb_{name};" for name in deployment.policies)
    head = f"/* Generated for {deployment.name}: settings, and where the weights are. */"
    return _guarded("CFB_DATA_H", head, f'#include "cfb_network.h"\n\n{defines}\n\n{networks}')


def _data(deployment: Deployment) -> str:
    parts = [f'/* Generated for {deployment.name}: weights. */\n#include "cfb_data.h"\n\n#include <stddef.h>\n']
    for name, policy in deployment.policies.items():
        parts.append(_network(name, policy))
    if deployment.loadable:
        parts.append(_loaded(deployment.holder))
    return "\n".join(parts)


def _network(name: str, policy: PolicyFile) -> str:
    arrays, values, scales = weight_arrays(policy), policy.controller.layout.setpoint_scales, "NULL"
    where = {key: f"{name}_{key}" for key in arrays}
    parts = [f"/* weights_sha256 {policy.weights_sha256} */", *(_array(where[key], x) for key, x in arrays.items())]
    if values:
        scales = f"{name}_setpoint_scales"
        parts.append(_array(scales, np.asarray(values, np.float32)))
    return "\n\n".join([*parts, _structure(name, policy, where, scales)])


def _loaded(policy: PolicyFile) -> str:
    """The same network with the weights of the set in memory, which begins with four outputs of a hover."""
    where, at = {}, 4
    for key, x in weight_arrays(policy).items():
        where[key] = f"cfb_written.numbers + {at}"
        at += x.size
    return '#include "cfb_weights.h"\n\n' + _structure("loaded", policy, where, "NULL")


def _structure(name: str, policy: PolicyFile, where: Mapping[str, str], scales: str) -> str:
    """A network whose arrays are at the C expressions ``where``."""
    network, layout, layers = policy.controller.network, policy.controller.layout, []
    for i, weight in enumerate(network.weights):
        inputs, outputs = weight.shape
        layers.append(f"    {{{inputs}, {outputs}, {where[f'weight_{i}']}, {where[f'bias_{i}']}}},")
    fields = {
        "position": int(layout.position),
        "body_position": int(layout.body_position),
        "body_velocity": int(layout.body_velocity),
        "integral": int(layout.integral),
        "past_estimates": layout.past_estimates,
        "estimate_stride": layout.estimate_stride,
        "past_commands": layout.past_commands,
        "previews": len(layout.preview_s),
        "setpoints": len(layout.setpoint_scales),
        "position_limit": literal(layout.position_limit_m),
        "position_bend": literal(layout.position_bend_m),
        "position_scale": literal(layout.position_scale_m),
        "velocity_bend": literal(layout.velocity_bend_mps),
        "velocity_scale": literal(layout.velocity_scale_mps),
        "rate_scale": literal(layout.rate_scale_radps),
        "integral_input_limit": literal(layout.integral_input_limit_m),
        "integral_limit": literal(layout.integral_limit_ms),
        "preview_scale": literal(layout.preview_scale_m),
        "dt": literal(layout.control_dt_s),
        "setpoint_scales": scales,
        "activation": f"CFB_{network.activation.upper()}",
        "limit": f"CFB_LIMIT_{network.limit.upper()}",
        "layers": len(layers),
        "layer": f"{name}_layers",
    }
    if network.gru is not None:
        inputs, size = network.sizes[network.before]
        arrays = ", ".join(value for key, value in where.items() if key.startswith("gru"))
        fields |= {"before": network.before, "gru": f"{{{inputs}, {size}, {arrays}}}"}
    table = f"static const cfb_layer_t {name}_layers[] = {{\n" + "\n".join(layers) + "\n};"
    body = "\n".join(f"    .{key} = {value}," for key, value in fields.items())
    return f"{table}\n\nconst cfb_network_t cfb_{name} = {{\n{body}\n}};\n"


def _array(name: str, values: np.ndarray) -> str:
    numbers = [literal(x) for x in values.reshape(-1)]
    rows = [", ".join(numbers[i : i + 8]) for i in range(0, len(numbers), 8)]
    return f"static const float {name}[{len(numbers)}] = {{\n    " + ",\n    ".join(rows) + ",\n};"
