"""The contract of an exported policy: all inputs and outputs with unit, frame, rate and scale."""

from __future__ import annotations

import math
from typing import Any

from cfb_mjx import __version__
from cfb_mjx.control.neural import WRITTEN
from cfb_mjx.control.policy_file import PolicyFile, about_gru
from cfb_mjx.deploy.deployment import CATCH_S, Deployment
from cfb_mjx.deploy.weights import about_set
from cfb_mjx.envs.observation import Layout
from cfb_mjx.firmware.actions import ACTIONS
from cfb_mjx.optional import not_none

FORMAT = "cfb_mjx contract 1"
BLIND_STEPS = 5
"""Number of steps without an estimate after which the motors are stopped."""
FROZEN_STEPS = 12
"""Number of steps after which a moving estimate that is still the same, bit for bit, stops the motors."""
LARGEST = 1e6
"""Largest valid input."""


def contract(deployment: Deployment) -> dict[str, Any]:
    """Return the contract of an export, for JSON."""
    layout = deployment.holder.controller.layout
    trained = deployment.trained_on()
    found: dict[str, Any] = {
        "format": FORMAT,
        "name": deployment.name,
        "cfb_mjx": __version__,
        "step_s": layout.control_dt_s,
        "inputs": _inputs(),
        "output": _output(layout),
        "heading": "held at zero: the body's x axis along the world's",
        "estimate_delay_s": deployment.pose_delay(),
        "first_step": {
            "meaning": "history is filled with the first estimate and the outputs of a hover",
            "outputs": deployment.settled().tolist(),
            "hover_command": deployment.hover_command(),
        },
        "safety": {
            "largest_input": LARGEST,
            "blind_steps": BLIND_STEPS,
            "blind": "an input that is not finite or too large, or a quaternion of norm zero: the last command again",
            "stopped": "after blind_steps of them, or without a last command: stopped until cfb_policy_reset()",
            "frozen_steps": FROZEN_STEPS,
            "frozen": "an estimate that moves and is the same, bit for bit, after frozen_steps steps: stopped likewise",
            "when_stopped": "the command is 0; motors off",
            "saturation": "commands are within their ranges whatever the input",
        },
        "policies": {name: _policy(policy) for name, policy in deployment.policies.items()},
        "trained_on": trained,
    }
    if deployment.loadable:
        found["weights_set"] = about_set(deployment)
    if deployment.flips:
        ranges, manoeuvre = deployment.setpoint_ranges, not_none(deployment.manoeuvre)
        found["flip"] = {
            "begins": "with the step after cfb_policy_set_flip(v_target, rate_target)",
            "v_target": {"unit": "m/s", "meaning": "speed along the body's z axis", "range": ranges["speed_mps"]},
            "rate_target": {"unit": "rad/s", "meaning": "rate about the body's x axis", "range": ranges["rate_radps"]},
            "rotations": manoeuvre.rotations,
            "knobs": {k: float(v) for k, v in manoeuvre.knobs._asdict().items() if math.isfinite(v)},
            "catch_s": CATCH_S,
        }
    return found


def _inputs() -> list[dict[str, Any]]:
    world = "world: z up, right-handed"
    return [
        {"name": "position", "length": 3, "unit": "m", "frame": world},
        {"name": "velocity", "length": 3, "unit": "m/s", "frame": world},
        {
            "name": "quaternion_wxyz",
            "length": 4,
            "unit": "1",
            "frame": "body to world, order w, x, y, z (the firmware's is x, y, z, w); normalised before use",
        },
        {
            "name": "body_rate",
            "length": 3,
            "unit": "rad/s",
            "frame": "body: x forward, y left, z up (the firmware's gyro is in deg/s)",
        },
        {"name": "target", "length": 3, "unit": "m", "frame": world},
    ]


def _output(layout: Layout) -> dict[str, Any]:
    if layout.action == "motors":
        return {
            "name": "command",
            "action": "motors",
            "length": 4,
            "order": ["M1 front right", "M2 back right", "M3 back left", "M4 front left"],
            "range": [0.0, 1.0],
            "meaning": "share of the battery's voltage (duty) at the motor; 65535 of the firmware is 1",
            "battery_compensation": "off",
        }
    return {
        "name": "command",
        "action": layout.action,
        "length": 4,
        "of": [{"name": x.name, "unit": x.unit, "range": [x.low, x.high]} for x in ACTIONS[layout.action].outputs],
        "meaning": "set-points of the firmware's own loops: outputs u from 0 to 1 are low + (high - low) u",
        "battery_compensation": "off",
    }


def _policy(policy: PolicyFile) -> dict[str, Any]:
    network, layout = policy.controller.network, policy.controller.layout
    config = policy.training.get("config") or {}
    return {
        "task": policy.task,
        "weights_sha256": policy.weights_sha256,
        "weights_hashed": "little-endian float32, each layer's weights (inputs, outputs) and biases, first layer first",
        "layers": [layout.size, *(given for _, given in network.sizes)],
        "activation": network.activation,
        "output": f"u = (1 + {WRITTEN[network.limit]}) / 2",
        **(about_gru(network) if policy.controller.recurrent else {}),
        "multiply_accumulates": network.multiply_accumulates,
        "observation": _observation(layout),
        "history": {
            "past_estimates": layout.past_estimates,
            "estimate_stride_steps": layout.estimate_stride,
            "past_commands": layout.past_commands,
            "integral": layout.integral,
        },
        "training": {
            key: config.get(key)
            for key in ("task", "model", "algorithm", "seed", "randomisation", "noise", "setpoints")
            if key in config
        },
        "versions": policy.training.get("versions"),
    }


def _bend(bend: float, unit: str) -> dict[str, str]:
    return {"bend": f"its length d then made b asinh(d / b), b = {bend} {unit}"} if bend else {}


def _observation(layout: Layout) -> list[dict[str, Any]]:
    """Segments of the network's input, in order."""
    axes = "body" if layout.body_velocity else "world"
    frame: list[dict[str, Any]] = []
    if layout.position:
        frame.append(
            {
                "name": "position - target" + (", body axes" if layout.body_position else ""),
                "length": 3,
                "unit": "m",
                "divided_by": layout.position_scale_m,
                "limit": f"shortened to a length of {layout.position_limit_m} m",
            }
            | _bend(layout.position_bend_m, "m")
        )
    frame += [
        {"name": f"velocity, {axes} axes", "length": 3, "unit": "m/s", "divided_by": layout.velocity_scale_mps}
        | _bend(layout.velocity_bend_mps, "m/s"),
        {"name": "rotation matrix, body to world, by rows", "length": 9, "unit": "1", "divided_by": 1.0},
        {"name": "body rate", "length": 3, "unit": "rad/s", "divided_by": layout.rate_scale_radps},
    ]
    segments: list[dict[str, Any]] = [{"name": "newest estimate", "length": layout.frame, "of": frame}]
    for i in range(1, layout.past_estimates + 1):
        steps = i * layout.estimate_stride
        segments.append({"name": f"estimate {steps} steps ago", "length": layout.frame, "of": "as the newest"})
    for i in range(1, layout.past_commands + 1):
        segments.append({"name": f"command {i} steps ago", "length": 4, "of": "2 u - 1"})
    if layout.integral:
        segments.append(
            {
                "name": "integral of position - target",
                "length": 3,
                "unit": "m s",
                "divided_by": layout.integral_limit_ms,
                "limit": f"inputs within {layout.integral_input_limit_m} m, sum within {layout.integral_limit_ms} m s",
            }
        )
    axes = "body" if layout.body_position else "world"
    for ahead in layout.preview_s:
        name = f"target {ahead:g} s from now - target, {axes} axes"
        segments.append({"name": name, "length": 3, "unit": "m", "divided_by": layout.preview_scale_m})
    names = ("v_target, m/s", "rate_target, rad/s")
    for name, scale in zip(names, layout.setpoint_scales, strict=False):
        segments.append({"name": name, "length": 1, "divided_by": scale})
    return segments
