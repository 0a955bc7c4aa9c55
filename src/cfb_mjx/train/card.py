"""Cards of policies: how one was trained and what it scored, in Markdown."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cfb_mjx.firmware.actions import ACTIONS

ALGORITHMS = {"ppo": "PPO", "analytic": "Back-propagation through the model"}


def training_card(
    config: Mapping[str, Any], model: str, start: str | None, commands: int, scores: Mapping[str, float]
) -> str:
    """Return the card of a policy that `cfb train` writes. It holds no dates or times, as the policy's file.

    Args:
        config: configuration of the training (`cfb_mjx.train.config.TrainingConfig.to_mapping`).
        model: name of the model on which it was trained.
        start: SHA-256 of the weights from which the training started; None: random ones.
        commands: number of commands flown.
        scores: scores at the last checkpoint by name; empty: it was not evaluated.
    """
    described = " ".join(str(config.get("description", "")).split())
    begun = "" if start is None else f" It continues the policy with the weights {start[:12]}."
    lines = [f"# A policy for the task {config['task']}", "", *([described, ""] if described else [])]
    lines += ["## Training", ""]
    how = ALGORITHMS[config["algorithm"]]
    lines += [f"- {how}, seed {config['seed']}: {commands / 1e6:.3g} M commands.{begun}", ""]
    lines += ["## Conditions of the training", "", *conditions({**config, "model": model}), ""]
    lines += ["## Scores", ""]
    lines += [f"- {name}: {value:.3g}" for name, value in scores.items()] or ["Not evaluated."]
    return "\n".join(lines) + "\n"


def conditions(config: Mapping[str, Any]) -> list[str]:
    """Return lines on the drones, the delays and noise of the estimates, and the observation of a training.

    Args:
        config: configuration of the training (`cfb_mjx.train.config.TrainingConfig.to_mapping`).
    """
    random, noise, seen = config["randomisation"], config["noise"], config["observation"]
    milder = f"; a share of {random['graded']:g} of the episodes has milder drones" if random.get("graded") else ""
    late = f" plus up to {1e3 * noise['pose_jitter_s']:g} ms" if noise.get("pose_jitter_s") else ""
    whose = "for pose and gyro" if config.get("lumped_delay", True) else "for the pose; the gyro is read on the drone"
    lines = [
        f"- Model `{config['model']}`, randomisation `{random['ranges']}` x {random['magnitude']:g}{milder}.",
        f"- Delay of the estimates: the model's `pose_delay`{late}, {whose}. Noise: {1e3 * noise['position_m']:g} mm, "
        f"{1e3 * noise['velocity_mps']:g} mm/s, {1e3 * noise['attitude_rad']:g} mrad, "
        f"{1e3 * noise['rate_radps']:g} mrad/s.",
    ]
    told = f"{1 + seen['past_estimates']} estimates, {seen['past_commands']} past commands"
    ahead = ", ".join(f"{1e3 * x:g}" for x in seen.get("preview_s") or ())
    told += f", where the target will be in {ahead} ms" if ahead else ""
    told += ", an integral of the position error" if seen.get("integral") else ""
    given = ACTIONS[seen.get("action", "motors")].words
    return [*lines, f"- Observation: {told}. It commands {given}, every {1e3 * seen['control_dt_s']:g} ms."]
