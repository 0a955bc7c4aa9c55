"""``cfb fly``: fly a controller in simulation and measure its performance."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from cfb_mjx.commands.command import Command, Devices, Figure, File, Model, Pairs, Within, command
from cfb_mjx.commands.flown import Flown
from cfb_mjx.documents import require_seed
from cfb_mjx.errors import CfbError
from cfb_mjx.files import require_folder, together, write_json
from cfb_mjx.optional import not_none

if TYPE_CHECKING:
    from cfb_mjx.control.controllers import Controller
    from cfb_mjx.control.manoeuvre import Manoeuvre
    from cfb_mjx.envs import TargetTask
    from cfb_mjx.model import Quadrotor
    from cfb_mjx.parameters import ModelFile
    from cfb_mjx.train.flight import Flight

_ROUNDS = 20


@command
class Fly(Command):
    """Fly a controller in simulation and measure its performance.

    The tasks, chosen with --task:

    - hover: 6 s at the target; the first second is not counted.
    - step: a step of the target by 6 m to one side.
    - recover: the drone starts thrown at 3 m/s and tilted by 60 deg.
    - track: follow a path from hover at its beginning; the first 4 s of the figure eight are not counted.
    - land: from about 1 m above a pad and up to 1 m beside it, onto a floor whose cushion of air lifts the drone
      (ground_effect, with published numbers unless the model has its own). The motors stop when the estimate says that
      it has touched down. Landed: slower than 0.3 m/s at the first contact, and at rest on its feet within 10 cm.
    - cross: two drones exchange places four times, 1.2 m apart in 2.5 s, the second 0.3 m below the first and in its
      wake (downwash, with a published strength unless the model has its own). Measured is the second drone.
    - follow: a drone follows another, 0.3 m below it and in its wake, along a figure eight of 2 m by 1 m in 8 s. It is
      sent the position, velocity and acceleration of the leader, which is not measured. Here and in cross, figures and
      logs show the second drone.
    - flip, double-flip, triple-flip: climb, turn about the x axis, and return to the start. `cfb fly double-flip` is
      short for `cfb fly flip --task double-flip`.

    Prints the measured numbers; over several flights these are means, with quantiles and the success rate.

    Attributes:
        controller: a shipped policy, a policy file (.npz of `cfb train`, .onnx), the name of a flip, pid or mellinger.
            pid and mellinger are the controllers of the firmware.
        task: task to fly. Default: hover, flip for a flip policy, track for a policy that sees ahead.
        model: preset or model YAML of the drone, with its effects.
        plants: number of flights, at least 1, each on a drone drawn from the randomisation.
        magnitude: factor on the ranges of the randomisation; 0 flies the model itself.
        randomisation: ranges of the randomisation: a shipped name, a YAML file or a model.
            The parameters of such a model must have a spread between drones (cfb-fleet).
        on: fly the model with each list of effects of a set in turn: off-nominal (shipped) or a YAML file.
        noise: add the noise of the state and the estimates that policies are trained with.
        seed: seed of all random numbers.
        json: JSON file for the results.
        figure: file for a figure of the flights (.png, .svg, .pdf).
        recording: file for a recording of the flights for rerun (.rrd).
        video: file for a video of the first flight (.mp4 or .gif).
        log: file for a flight log of the first flight (.mcap), which cfb view, evaluate and fit can read.
        knobs: settings of a flip: when it switches phase, and its set-points.
            A shipped manoeuvre (flip-wide, double-flip-low ...) or a YAML file. Default: those of the task.
        set: changes to the settings of a flip, for instance rate_radps=18 climb_s=0.4; --search does not change these.
        holder: target policy that climbs before a flip and catches the drone after it.
            Default: the one with which the settings of the flip were found.
        search: search for the settings of a flip before flying.
            height: smallest height needed on the model.
            margin: most randomised drones that complete the flip, as high above the floor as possible.
            The model itself then keeps within 1.8 m.
            within: most randomised drones that complete the flip within 1.8 m.
        keep: YAML file for the settings of the flip that were flown, for --knobs.
        path: path of --task track, and of the leader in --task follow: figure-eight (2 m by 1 m in 2 s), random
            (through random points of --seed), or a trajectory file (.csv: durations and polynomials as in
            uav_trajectories, which the firmware also flies). Default: figure-eight; for follow in 8 s.
        timescale: factor on all times of the path, as in the firmware: 2 is half as fast.
        devices: number of devices of this machine over which the flights are divided.
        gyro: delay of the gyro. late: as late as the pose, by the model's pose_delay, as in the paper.
            local: read on the drone, late by gyro_delay only.
            Default: for a policy as it was trained; local for pid and mellinger, as in the firmware.
    """

    controller: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="CONTROLLER")]
    task: (
        Literal["hover", "step", "recover", "track", "land", "cross", "follow", "flip", "double-flip", "triple-flip"]
        | None
    ) = None
    model: Model = "cfb-guards"
    plants: int = 1
    magnitude: Annotated[float, Within(0)] = 0.0
    randomisation: Annotated[str, tyro.conf.arg(metavar="NAME", aliases=["--randomise"])] = "paper"
    on: Annotated[str | None, tyro.conf.arg(metavar="SET")] = None
    noise: bool = True
    seed: int = 0
    json: File = None
    figure: Figure = None
    recording: File = None
    video: File = None
    log: File = None
    knobs: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    set: Pairs = ()
    holder: Annotated[str | None, tyro.conf.arg(metavar="CONTROLLER")] = None
    search: Literal["height", "margin", "within"] | None = None
    keep: File = None
    path: Annotated[str | None, tyro.conf.arg(metavar="PATH")] = None
    timescale: float = 1.0
    devices: Devices = 1
    gyro: Literal["late", "local"] | None = None

    def run(self) -> Flown:
        """Fly, measure, and write the files that were asked for.

        Raises:
            CfbError: an unknown controller, model or randomisation, numbers outside their range, options that would
                have no effect, or files that cannot be written.
        """
        from cfb_mjx.runtime import configure_jax, environment

        self._check()
        configure_jax(x64=False, devices=self.devices)
        import jax
        import numpy as np

        from cfb_mjx.control.controllers import find_controller, has_lumped_delay, is_flip_policy, is_tracking_policy
        from cfb_mjx.devices import Devices
        from cfb_mjx.envs import Noise, TargetTask
        from cfb_mjx.envs.task import QUIET, with_room
        from cfb_mjx.model import Quadrotor, require_possible
        from cfb_mjx.parameters import load_model_file, load_randomisation
        from cfb_mjx.train.flips import FLIPS
        from cfb_mjx.train.measuring import measured
        from cfb_mjx.train.together import led
        from cfb_mjx.train.tracking import demanded, find_course

        name, task = self.controller, self.task
        if task is None and name in FLIPS:
            name, task = "flip", name
        described = load_model_file(self.model)
        nominal = Quadrotor.from_file(described)
        spread = load_randomisation(self.randomisation)
        require_possible(nominal, spread, self.magnitude, "--magnitude")
        # The controller is scaled for the model that was named, also if --on flies it on other drones.
        controller, manoeuvre = find_controller(name, nominal), None
        course = TargetTask(
            noise=Noise() if self.noise else QUIET,
            randomisation=spread if self.magnitude else None,
            magnitude=self.magnitude,
            lumped_delay=has_lumped_delay(name) if self.gyro is None else self.gyro == "late",
        )
        if task is None:
            ahead = is_tracking_policy(controller) or self.path is not None
            task = "flip" if is_flip_policy(controller) else "track" if ahead else "hover"
        flips = task in FLIPS
        if flips:
            wild = replace(course, randomisation=spread, magnitude=self.magnitude or 1.0)
            manoeuvre = self._manoeuvre(controller, name, task, wild, nominal)
            controller = manoeuvre
        else:
            if is_flip_policy(controller):
                raise CfbError(f"{name}: is a flip policy and cannot fly --task {task}; fly flip or double-flip.")
            if any((self.knobs, self.set, self.holder, self.search, self.keep)):
                raise CfbError(f"--knobs, --set, --holder, --search and --keep are for flips, not for --task {task}.")
        along = task in ("track", "follow")
        if not along and (self.path is not None or self.timescale != 1):
            raise CfbError(f"--path and --timescale are for --task track and follow, not for {task}.")
        way = None
        if task == "follow" and self.path is None:
            way = led(self.timescale)
        elif along:
            way = find_course(self.path or "figure-eight", self.seed, self.timescale)
        keys = jax.random.split(jax.random.PRNGKey(self.seed), self.plants)
        fly = measured(task, controller, with_room(course, nominal), keys, Devices.take(self.devices), way)
        numbers = {"controller": name, "task": task, "model": self.model, "plants": self.plants}
        numbers |= {"magnitude": self.magnitude, "gyro": "late" if course.lumped_delay else "local"}
        if way is not None:
            numbers["path"] = {"name": self.path or "figure-eight", "timescale": self.timescale, **demanded(way)}
            _warn_if_infeasible(numbers["path"], nominal)
        if manoeuvre is not None:
            numbers["knobs"] = {name: float(x) for name, x in manoeuvre.knobs._asdict().items() if np.isfinite(x)}
        found, flown = self._measured(fly, described, nominal)
        numbers |= found
        numbers |= {"environment": environment()}
        with together():
            if self.json is not None:
                write_json(self.json, numbers)
            if any(self._shown.values()):
                from cfb_mjx.view.flight import write_flights

                title = f"{name}, {task}, {self.model}"
                # Not None: `_check` allows these files only for flights of one model.
                kind = "flip" if flips else task
                write_flights(not_none(flown), controller.control_dt_s, nominal, title, kind, **self._shown)
        return Flown(numbers, {"knobs": self.keep, "results": self.json, **self._shown}, self.search is not None)

    @property
    def _shown(self) -> dict[str, Path | None]:
        """Paths of the files that show the flights of one model."""
        return {"figure": self.figure, "recording": self.recording, "video": self.video, "log": self.log}

    def _check(self) -> None:
        require_folder(self.json, *self._shown.values(), self.keep)
        if self.on is not None and any(self._shown.values()):
            raise CfbError(
                "--figure, --recording, --video and --log show flights of one model; leave out --on, or give one drone "
                "with --model."
            )
        if self.video is not None:
            from cfb_mjx.view.film import check_film

            check_film(self.video)
        if self.plants < 1:
            raise CfbError(f"--plants {self.plants}: must be 1 or more; at least one drone must fly.")
        require_seed(self.seed, "--seed")

    def _measured(
        self, fly: Callable[[Quadrotor], tuple[dict[str, Any], Flight]], described: ModelFile, nominal: Quadrotor
    ) -> tuple[dict[str, Any], Flight | None]:
        """The results on the model and its flights; with --on the results on each drone of the set, and None."""
        if self.on is None:
            return fly(nominal)
        from cfb_mjx.runtime import Progress
        from cfb_mjx.train.flying import load_plants

        drones, bar, found = load_plants(described, self.on), Progress("flying"), {}
        for name, drone in drones.items():
            found[name], _ = fly(drone)
            bar(len(found), len(drones), name)
        return {"set": self.on, "on": found}, None

    def _manoeuvre(
        self, turner: Controller, controller: str, task: str, wild: TargetTask, nominal: Quadrotor
    ) -> Manoeuvre:
        """The controller of a flip, with its settings found by a search and written to a file if asked for.

        Args:
            turner: the flip policy.
            controller: name of the flip policy.
            task: name of the flip.
            wild: task with the randomisation that the searches margin and within use.
            nominal: the drone.

        Raises:
            CfbError: not a flip policy, a holder that is not a target policy, or invalid settings of the flip.
        """
        from cfb_mjx.control.controllers import find_controller, is_flip_policy
        from cfb_mjx.control.manoeuvre import Manoeuvre, load_manoeuvre, save_manoeuvre
        from cfb_mjx.control.neural import NeuralController
        from cfb_mjx.runtime import Progress
        from cfb_mjx.train.flips import FLIPS, Goal, improved

        if not isinstance(turner, NeuralController) or not is_flip_policy(turner):
            raise CfbError(
                f"{controller}: is not a flip policy and cannot fly --task {task}; give flip or one of cfb train flip."
            )
        described = load_manoeuvre(self.knobs or task, self.set)
        described = replace(described, holder=self.holder or described.holder)
        holder = find_controller(described.holder, nominal)
        if not isinstance(holder, NeuralController) or is_flip_policy(holder):
            raise CfbError(
                f"holder {described.holder}: must be a target policy, for instance target or target-adaptive."
            )
        if described.rotations != FLIPS[task]:
            raise CfbError(
                f"--knobs {self.knobs}: turn {described.rotations} times, but --task {task} turns {FLIPS[task]} times."
            )
        manoeuvre = Manoeuvre(holder, turner, described.knobs)
        if self.search is not None:
            goal, bar = Goal(described.rotations, self.search), Progress("searching")
            fixed = [change.partition("=")[0] for change in self.set]
            manoeuvre = improved(
                manoeuvre,
                wild,
                nominal,
                goal,
                self.seed,
                fixed,
                _ROUNDS,
                report=lambda done, cost: bar(done, _ROUNDS, f"cost {cost:.4f}"),
            )
        if self.keep is not None:
            save_manoeuvre(replace(described, knobs=manoeuvre.knobs), self.keep)
        return manoeuvre


def _warn_if_infeasible(path: Mapping[str, Any], nominal: Quadrotor) -> None:
    """Warn if a path asks for more thrust than the drone has."""
    import warnings

    from cfb_mjx.errors import CfbWarning
    from cfb_mjx.model import balanced_thrust_to_weight

    lifts = float(balanced_thrust_to_weight(nominal.changed_parameters()))
    if path["thrust_to_weight"] > lifts:
        warnings.warn(
            f"--path {path['name']}: asks for {path['thrust_to_weight']:.2f} times the drone's weight, its rotors lift "
            f"{lifts:.2f} times; fly it slower with --timescale.",
            CfbWarning,
            stacklevel=2,
        )
