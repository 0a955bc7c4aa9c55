"""Configuration of a training: one YAML file with strict keys and types."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from cfb_mjx.documents import load_named, parse_yaml, require_seed, told, with_former
from cfb_mjx.envs import FlipReward, FlipStarts, FlipTask, Layout, Noise, Setpoints, Starts, TargetReward, TargetTask
from cfb_mjx.envs.flip import FLIP_LAYOUT
from cfb_mjx.envs.observation import BEFORE_BENDS
from cfb_mjx.envs.track import TRACK_LAYOUT, TRACK_STARTS, Paths, TrackTask
from cfb_mjx.errors import CfbError
from cfb_mjx.firmware.actions import ACTIONS
from cfb_mjx.parameters.randomisation import load_randomisation
from cfb_mjx.train.cost import FlipCost, SmoothCost
from cfb_mjx.train.strict import build, plain

FORMAT = "cfb_mjx training 1"


@dataclass(frozen=True)
class NetworkSettings:
    """The policy's network; the paper's is fully connected with four layers of 32."""

    hidden: tuple[int, ...] = (32, 32, 32, 32)
    activation: Literal["tanh", "relu", "swish"] = "tanh"


@dataclass(frozen=True)
class RandomisationSettings:
    """Drones to train on."""

    ranges: str = "paper"
    """Name of a shipped randomisation, or a YAML file."""
    magnitude: float = 1.0
    """Factor on all ranges; 0 trains on the nominal drone alone."""
    graded: float = 0.3
    """Share of the episodes that draw their own factor between 0 and ``magnitude``. Without it the nominal drone would
    never be flown, because uniform draws of a dozen numbers are never all near their means."""


@dataclass(frozen=True)
class AnalyticSettings:
    """Back-propagation through the simulator."""

    drones: int = 256
    horizon_s: float = 1.0
    updates: int = 600
    learning_rate: float = 2e-3
    """Initial learning rate; it decays to zero along a cosine."""
    gradient_clip: float = 1.0
    cost: SmoothCost | FlipCost = field(default_factory=SmoothCost)
    """The cost; flips have `FlipAnalyticSettings`, so a cost in a file is read as a target's here."""


@dataclass(frozen=True)
class FlipAnalyticSettings(AnalyticSettings):
    """Back-propagation through the simulator, for flips."""

    drones: int = 512
    horizon_s: float = 0.6
    updates: int = 1200
    cost: FlipCost = field(default_factory=FlipCost)


@dataclass(frozen=True)
class PpoSettings:
    """Proximal policy optimisation (Schulman et al. 2017)."""

    drones: int = 256
    """Number of drones, including copies."""
    unroll: int = 128
    """Commands per drone between two updates of the policy."""
    minibatches: int = 8
    epochs: int = 4
    steps: int = 200_000_000
    """Total number of commands."""
    learning_rate: float = 5e-4
    """Initial learning rate; it decays linearly to ``last_rate`` of that."""
    value_learning_rate: float = 1e-3
    """Initial learning rate of the value network, with the same decay."""
    last_rate: float = 0.02
    """Final share of both learning rates: the smaller it is, the smaller the random error of the last policy."""
    discount: float = 0.995
    gae_lambda: float = 0.98
    clipping: float = 0.2
    advantage_limit: float = 20.0
    """Advantages are clipped at this multiple of their mean magnitude. Otherwise the few drones that fail, by a large
    amount, would dominate what all the others should learn about their last decimetre."""
    copies: int = 4
    """Drones that fly the same episode with different actions. Advantages are taken relative to the mean of the copies,
    so that errors of the value network that are common to them cancel. Copies begin and end together."""
    smoothness: float = 6.0
    """Penalty on |u_(k+1) - u_k|^2 of the policy's means, with commands from -1 to 1 (Mysore et al. 2021, CAPS);
    exploration noise costs nothing. It is added to advantages that are divided by their standard deviation, which
    decreases as the policy improves, so in units of the reward the penalty decreases too."""
    entropy_cost: float = 3e-3
    """Initial entropy cost; it decays linearly to ``last_entropy`` of that."""
    last_entropy: float = 0.02
    reward_scaling: float = 0.02
    least_reward: float = -30.0
    """Lower rewards, such as the paper's -300 for a failure, are clipped to this value for the learner."""
    gradient_clip: float = 1.0
    first_std: float = 0.2
    """Initial standard deviation of the Gaussian before the tanh."""
    largest_kl: float = 0.02
    """Limit of the KL divergence between the policies before and after an update, kept by lowering the policy's
    learning rate; 0: no limit. A policy that holds a drone to the centimetre changes a hundred times as much with its
    weights as an untrained one."""
    warm_up: int = 10
    """Number of first updates in which only the value network learns, if a training starts from a policy (--start)."""
    warm_std: float = 0.06
    """``first_std`` for a training that starts from a policy."""
    value_hidden: tuple[int, ...] = (64, 64)

    @property
    def updates(self) -> int:
        """Number of updates, each after ``unroll`` commands."""
        return -(-self.steps // (self.drones * self.unroll))


@dataclass(frozen=True)
class FlipPpoSettings(PpoSettings):
    """PPO for flips: a command acts on a turn for a shorter time, and the value network errs little."""

    drones: int = 512
    copies: int = 1
    learning_rate: float = 1e-3
    advantage_limit: float = 3.0
    smoothness: float = 0.0
    entropy_cost: float = 1e-3
    last_entropy: float = 1.0
    steps: int = 40_000_000
    discount: float = 0.97
    gae_lambda: float = 0.95
    reward_scaling: float = 0.1


@dataclass(frozen=True)
class TrainingConfig:
    """Configuration of a training. The defaults are those of ``configs/target.yaml``."""

    format: Literal["cfb_mjx training 1"] = FORMAT
    task: Literal["target", "flip", "track"] = "target"
    """The task; flips have `FlipTrainingConfig`, so rewards and starts in a file are read as a target's here."""
    description: str = ""
    model: str = "cfb-guards"
    """Name of a preset, or a model YAML."""
    body: Literal["rigid", "mjx"] = "rigid"
    algorithm: Literal["ppo", "analytic"] = "ppo"
    seed: int = 0
    checkpoints: int = 20
    """Number of checkpoints, evenly spaced in the training. At each the policy is evaluated for the learning curve."""
    episode_s: float = 4.0
    lumped_delay: bool = True
    """Whether the gyro is as late as the pose, as in the paper, or only by the model's ``gyro_delay``."""
    network: NetworkSettings = field(default_factory=NetworkSettings)
    observation: Layout = field(default_factory=Layout)
    reward: TargetReward | FlipReward = field(default_factory=TargetReward)
    starts: Starts | FlipStarts = field(default_factory=Starts)
    noise: Noise = field(default_factory=partial(Noise, pose_jitter_s=0.012))
    randomisation: RandomisationSettings = field(default_factory=RandomisationSettings)
    analytic: AnalyticSettings = field(default_factory=AnalyticSettings)
    ppo: PpoSettings = field(default_factory=PpoSettings)

    def build_task(self) -> TargetTask | FlipTask:
        """Return the task to train on."""
        # The configurations of other tasks override this.
        assert isinstance(self.reward, TargetReward)
        assert isinstance(self.starts, Starts)
        return TargetTask(reward=self.reward, starts=self.starts, **self._common())

    def _common(self) -> dict[str, Any]:
        chosen = self.randomisation
        return {
            "layout": self.observation,
            "noise": self.noise,
            "randomisation": load_randomisation(chosen.ranges) if chosen.magnitude else None,
            "magnitude": chosen.magnitude,
            "graded": chosen.graded,
            "episode_s": self.episode_s,
            "lumped_delay": self.lumped_delay,
        }

    def to_mapping(self) -> dict[str, Any]:
        """Return the contents of the equivalent YAML file."""
        return plain(self)


@dataclass(frozen=True)
class FlipTrainingConfig(TrainingConfig):
    """Configuration of a training to flip. The defaults are those of ``configs/flip.yaml``."""

    task: Literal["flip"] = "flip"
    episode_s: float = FlipTask.episode_s
    observation: Layout = FLIP_LAYOUT
    reward: FlipReward = field(default_factory=FlipReward)
    starts: FlipStarts = field(default_factory=FlipStarts)
    noise: Noise = field(default_factory=Noise)
    setpoints: Setpoints = field(default_factory=Setpoints)
    randomisation: RandomisationSettings = field(
        default_factory=partial(RandomisationSettings, ranges="paper", graded=0.5)
    )
    analytic: FlipAnalyticSettings = field(default_factory=FlipAnalyticSettings)
    ppo: FlipPpoSettings = field(default_factory=FlipPpoSettings)

    def build_task(self) -> FlipTask:
        """Return the task to train on."""
        return FlipTask(reward=self.reward, starts=self.starts, setpoints=self.setpoints, **self._common())


@dataclass(frozen=True)
class TrackTrainingConfig(TrainingConfig):
    """Configuration of a training to track paths. The defaults are those of ``configs/track.yaml``."""

    task: Literal["track"] = "track"
    observation: Layout = TRACK_LAYOUT
    starts: Starts = field(default_factory=partial(replace, TRACK_STARTS))
    noise: Noise = field(default_factory=Noise)
    paths: Paths = field(default_factory=Paths)

    def build_task(self) -> TrackTask:
        """Return the task to train on."""
        assert isinstance(self.reward, TargetReward)
        assert isinstance(self.starts, Starts)
        return TrackTask(reward=self.reward, starts=self.starts, paths=self.paths, **self._common())


_KINDS = {"target": TrainingConfig, "flip": FlipTrainingConfig, "track": TrackTrainingConfig}
_SHOWN = ("observation", "position_scale_m", BEFORE_BENDS)
_TOGETHER = {"target": (_SHOWN, ("reward", "position", {"near": 0.0})), "flip": (_SHOWN,), "track": ()}
"""Per task: group, a key of it that older configurations contain, and newer keys of the group with the values that
reproduce the old behaviour."""


def load_config(name_or_path: str | Path = "target", changes: tuple[str, ...] = ()) -> TrainingConfig:
    """Read a shipped training configuration (``target``, ``flip``) or a YAML file.

    Args:
        name_or_path: name or file.
        changes: changes, each ``KEY=VALUE`` with a dotted key and a YAML value.

    Raises:
        CfbError: there is no such file, a key is unknown, or a value has the wrong type or is out of range; the message
            names it.
    """
    path, document = load_named(name_or_path, "training", FORMAT)
    # Check the file before the changes, so that a fault of the file is not blamed on the command line.
    config = _unambiguous(document, str(path))
    if changes:
        for change in changes:
            _change(document, change)
        config = _unambiguous(document, f"{path} with {', '.join(changes)}")
    _require_sense(config, str(path))
    return config


def config_from(mapping: dict[str, Any], where: str) -> TrainingConfig:
    """Build a configuration from the contents of a YAML file; missing keys have their defaults.

    Args:
        mapping: contents of the file.
        where: name of the file, for messages.

    Raises:
        CfbError: a key is unknown or a value has the wrong type.
    """
    task = mapping.get("task", "target")
    if not isinstance(task, str) or task not in _KINDS:
        raise CfbError(f"{where}: task must be one of {', '.join(_KINDS)}, found {told(task)}.")
    for group, key, since in _TOGETHER[task]:
        if isinstance(given := mapping.get(group), dict):
            # The file may be older than these keys.
            mapping = mapping | {group: with_former(given, key, since)}
    return build(_KINDS[task], mapping, where)


def _unambiguous(mapping: dict[str, Any], where: str) -> TrainingConfig:
    """`config_from` for files of users: refuses groups that may mean either the old or the present defaults."""
    config = config_from(mapping, where)
    usual = plain(type(config)())
    for group, key, since in _TOGETHER[config.task]:
        given = mapping.get(group, {})
        if key in given and (absent := {k: before for k, before in since.items() if k not in given}):
            now = ", ".join(f"{k}: {told(usual[group][k])}" for k in absent)
            before = ", ".join(f"{k}: {told(value)}" for k, value in absent.items())
            raise CfbError(
                f"{where}: {group} gives {key}, but neither {now} (the default) nor {before} (the value of older "
                "versions); add one of the two."
            )
    return config


def with_changes(config: TrainingConfig, **values: Any) -> TrainingConfig:
    """Return a copy with some top-level settings replaced; values of None leave a setting unchanged.

    Raises:
        CfbError: the seed is out of range.
    """
    changed = replace(config, **{key: value for key, value in values.items() if value is not None})
    require_seed(changed.seed, "--seed")
    return changed


def _change(document: dict, change: str) -> None:
    dotted, equals, text = change.partition("=")
    if not equals or not dotted:
        raise CfbError(f"--set {change}: write KEY=VALUE, for instance randomisation.magnitude=0.5.")
    *path, last = dotted.split(".")
    inner = document
    for key in path:
        inner = inner.setdefault(key, {})
        if not isinstance(inner, dict):
            raise CfbError(f"--set {change}: {key} is not a group of settings.")
    inner[last] = parse_yaml(text, f"--set {change}")


_AT_LEAST = {
    "checkpoints": 1,
    "observation.past_estimates": 0,
    "observation.past_commands": 0,
    "observation.position_bend_m": 0,
    "observation.velocity_bend_mps": 0,
    "observation.estimate_stride": 1,
    "randomisation.magnitude": 0,
    "analytic.drones": 1,
    "analytic.updates": 1,
    "ppo.drones": 1,
    "ppo.unroll": 1,
    "ppo.minibatches": 1,
    "ppo.copies": 1,
    "ppo.epochs": 1,
    "ppo.steps": 1,
    "ppo.warm_up": 0,
    "ppo.largest_kl": 0,
    "ppo.smoothness": 0,
}
_POSITIVE = (
    "episode_s",
    "observation.control_dt_s",
    "observation.position_limit_m",
    "observation.position_scale_m",
    "observation.velocity_scale_mps",
    "observation.rate_scale_radps",
    "observation.integral_limit_ms",
    "reward.velocity_width_mps",
    "reward.body_rate_width_radps",
    "reward.speed_limit_mps",
    "reward.rate_limit_radps",
    "analytic.horizon_s",
    "analytic.learning_rate",
    "analytic.gradient_clip",
    "analytic.cost.velocity_width_mps",
    "ppo.learning_rate",
    "ppo.value_learning_rate",
    "ppo.gradient_clip",
    "ppo.advantage_limit",
    "ppo.first_std",
    "ppo.warm_std",
)


_POSITIVE_OF = {
    "target": (
        "reward.position_width_m",
        "reward.near_width_m",
        "reward.near_speed_mps",
        "reward.near_attitude",
        "reward.attitude_width",
        "reward.torque_width_nm",
        "analytic.cost.position_width_m",
    ),
    "flip": ("reward.axis_width", "analytic.cost.axis_width", "analytic.cost.body_rate_width_radps"),
}
_POSITIVE_OF["track"] = (*_POSITIVE_OF["target"], "observation.preview_scale_m", "paths.size_m")
_PAIRS = {"flip": ("setpoints.speed_mps", "setpoints.rate_radps", "starts.rotor_speed"), "track": ("paths.lap_s",)}


def _require_sense(config: TrainingConfig, where: str) -> None:
    for key, least in _AT_LEAST.items():
        if _at(config, key) < least:
            raise CfbError(f"{where}: {key} = {_at(config, key)} must be at least {least}.")
    require_seed(config.seed, f"{where}: seed =")
    for key in _POSITIVE + _POSITIVE_OF[config.task]:
        if not _at(config, key) > 0:
            raise CfbError(f"{where}: {key} = {_at(config, key)} must be positive.")
    for key in _PAIRS.get(config.task, ()):
        pair = _at(config, key)
        if len(pair) != 2 or pair[0] > pair[1]:
            raise CfbError(f"{where}: {key} must be two numbers, the smaller first, found {told(list(pair))}.")
    if isinstance(config, TrackTrainingConfig):
        paths = config.paths
        if not (paths.lap_s[0] > 0 and paths.thrust_to_weight > 1 and 0 <= paths.eights <= 1):
            raise CfbError(
                f"{where}: paths.lap_s must be positive, paths.thrust_to_weight larger than 1, and paths.eights "
                "between 0 and 1."
            )
    if config.task == "flip" and isinstance(config.reward, FlipReward) and len(config.reward.axis_direction) != 3:
        raise CfbError(f"{where}: reward.axis_direction must be three numbers.")
    if len(config.observation.setpoint_scales) != (2 if config.task == "flip" else 0):
        raise CfbError(f"{where}: observation.setpoint_scales needs one number for each set-point of {config.task}.")
    if (
        bool(config.observation.preview_s) != (config.task == "track")
        or min(config.observation.preview_s, default=1) <= 0
    ):
        raise CfbError(f"{where}: observation.preview_s needs positive times for track, and is for track alone.")
    if config.observation.action not in ACTIONS:
        raise CfbError(f"{where}: observation.action must be one of {', '.join(ACTIONS)}.")
    near = "starts.entering" if config.task == "flip" else "starts.near"
    for key in ("ppo.last_rate", "ppo.last_entropy", near, "randomisation.graded", "ppo.discount", "ppo.gae_lambda"):
        if not 0 <= _at(config, key) <= 1:
            raise CfbError(f"{where}: {key} = {_at(config, key)} must lie between 0 and 1.")
    for key in ("network.hidden", "ppo.value_hidden"):
        if not _at(config, key) or min(_at(config, key)) < 1:
            raise CfbError(f"{where}: {key} must contain at least one layer, each with at least one neuron.")
    if config.ppo.drones % (config.ppo.minibatches * config.ppo.copies):
        raise CfbError(
            f"{where}: ppo.drones = {config.ppo.drones} must be a multiple of ppo.minibatches times ppo.copies, "
            f"{config.ppo.minibatches} x {config.ppo.copies}."
        )
    load_randomisation(config.randomisation.ranges)


def _at(config: Any, dotted: str) -> Any:
    for key in dotted.split("."):
        config = getattr(config, key)
    return config
