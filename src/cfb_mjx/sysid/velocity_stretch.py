"""Model of a stretched velocity column, with its inverse: true to logged velocity and back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

LOOK, NOISE = 0.5, 0.015
"""Time over which position and velocity are compared, s, and error of the position over that time, m."""
BETWEEN, MOST = 0.1, 0.5
"""Standard deviation between flights of the excess share of the velocity, and its largest value."""


@dataclass(frozen=True)
class VelocityStretch:
    """Stretch of the logged velocity, at all frequencies or in a band.

    An estimator whose velocity follows a stretched flow slowly, and is eventually pulled back by corrections of the
    position, stretches neither fast nor slow motion. The excess in the logged velocity v is the share 1 - 1 / scale of
    v, low-passed with time constant ``rise``, minus the same low-passed again with time constant ``fade``.

    Attributes:
        scale: (3,) logged over true velocity along the world axes, at its maximum; or one such row per row or window.
        rise: time constant, s; 0: immediate.
        fade: time constant, s; None: it never fades.
    """

    scale: np.ndarray
    rise: float = 0.0
    fade: float | None = None

    @property
    def none(self) -> bool:
        """Whether there is no stretch."""
        return bool((self.scale == 1.0).all())

    @property
    def constant(self) -> bool:
        """Whether the stretch is the same at all frequencies, so that it has no memory."""
        return self.none or (self.rise == 0.0 and self.fade is None)

    def memory(self, time: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """States (N, 2, 3) of the two low-pass filters at every row, starting in steady state at the first row.

        Args:
            time: (N,) s.
            velocity: (N, 3) as logged, m/s.
        """
        if self.constant:
            return np.zeros((len(time), 2, 3))
        first = velocity[0], np.zeros(3) if self.fade is None else velocity[0]
        return self.carried(np.stack(first)[None], np.diff(time), velocity[None])[0]

    def undone(self, time: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """True velocities (N, 3) from logged ones, using no later rows.

        Args:
            time: (N,) s.
            velocity: (N, 3) as logged, m/s.
        """
        if self.constant:
            return velocity / self.scale
        slow, slower = np.moveaxis(self.memory(time, velocity), 1, 0)
        return velocity - self._share * (slow - slower)

    def done(self, memory: np.ndarray, step: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Logged velocities (W, H + 1, 3) from true ones.

        Args:
            memory: (W, 2, 3) filter states at the first velocity.
            step: (H,) time steps between the velocities, s.
            velocity: (W, H + 1, 3) true velocities, m/s.
        """
        if self.constant:
            return velocity * self.scale
        slow, slower = memory[:, 0], memory[:, 1]
        logged = [velocity[:, 0] + self._share * (slow - slower)]
        for i, h in enumerate(step):
            # The logged velocity and both filter states at the end of the step solve three linear equations.
            keep, last, now = lag_weights(h, self.rise)
            known = keep * slow + last * logged[-1]
            keep, last, share = (1.0, 0.0, 0.0) if self.fade is None else lag_weights(h, self.fade)
            carried = keep * slower + last * slow
            true = velocity[:, i + 1]
            slow = (known + now * (true - self._share * carried)) / (1.0 - now * self._share * (1.0 - share))
            slower = carried + share * slow
            logged.append(true + self._share * (slow - slower))
        return np.stack(logged, axis=1)

    def carried(self, memory: np.ndarray, step: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Filter states (W, H + 1, 2, 3) along logged velocities.

        Args:
            memory: (W, 2, 3) filter states at the first velocity.
            step: (H,) time steps between the velocities, s.
            velocity: (W, H + 1, 3) as logged, m/s.
        """
        found = [memory]
        for i, h in enumerate(step):
            (slow, slower), (before, after) = np.moveaxis(found[-1], 1, 0), (velocity[:, i], velocity[:, i + 1])
            keep, last, now = lag_weights(h, self.rise)
            next_slow = keep * slow + last * before + now * after
            if self.fade is not None:
                keep, last, now = lag_weights(h, self.fade)
                slower = keep * slower + last * slow + now * next_slow
            found.append(np.stack([next_slow, slower], axis=1))
        return np.stack(found, axis=1)

    def followed(self, position: np.ndarray, memory: np.ndarray) -> np.ndarray:
        """Positions (..., 3) that are consistent with the logged velocity.

        The stretch adds a bounded amount to the position, or an amount proportional to it if the stretch never fades.

        Args:
            position: (..., 3) m.
            memory: (..., 2, 3) filter states.
        """
        if self.fade is None:
            return self.scale * (position - self._share * self.rise * memory[..., 0, :])
        return position + self._share * self.fade * memory[..., 1, :]

    def left(self, followed: np.ndarray, memory: np.ndarray) -> np.ndarray:
        """Inverse of `followed`: positions (..., 3) from those consistent with the logged velocity."""
        if self.fade is None:
            return followed / self.scale + self._share * self.rise * memory[..., 0, :]
        return followed - self._share * self.fade * memory[..., 1, :]

    def learned(self, time: np.ndarray, velocity: np.ndarray, position: np.ndarray) -> np.ndarray:
        """Estimate this flight's horizontal scale recursively; each row of the result (N, 3) uses no later rows.

        Over `LOOK` seconds the position moves less than the integrated logged velocity, in proportion to the excess
        share. The estimate starts at the present scale. The prior deviation between flights is `BETWEEN`, the noise of
        the position is `NOISE`.

        Args:
            time: (N,) s.
            velocity: (N, 3) as logged, world axes, m/s.
            position: (N, 3) as logged, m.
        """
        steps = np.diff(time)[:, None]

        def travelled(rate):
            return np.concatenate([np.zeros((1, 3)), np.cumsum(steps * (rate[1:] + rate[:-1]) / 2, axis=0)])

        by_velocity, memory = travelled(velocity), self.memory(time, velocity)
        if self.fade is not None:
            never = self.fade * memory[:, 1]
        else:
            never = by_velocity - self.rise * memory[:, 0]
        before = np.searchsorted(time, time - LOOK - 1e-6)
        # The time spans overlap, so each row adds only the share of information that is new.
        new = np.minimum(np.diff(time, prepend=time[0]) / LOOK, 1.0)[:, None] * (before > 0)[:, None] / NOISE**2
        x = -(never - never[before])[:, :2]
        y = (position - position[before] - by_velocity + by_velocity[before])[:, :2]
        known = np.sum(np.cumsum(new * x * x, axis=0), axis=1) + 1 / BETWEEN**2
        told = np.sum(np.cumsum(new * x * y, axis=0) + self._share[:2] / (2 * BETWEEN**2), axis=1)
        share = np.clip(told / known, -MOST, MOST)
        scale = np.repeat(self.scale[None], len(time), axis=0)
        scale[:, :2] = 1 / (1 - share[:, None])
        return scale

    @property
    def _share(self) -> np.ndarray:
        return 1.0 - 1.0 / self.scale


def lag_weights(step: float, time: float) -> tuple[float, float, float]:
    """Weights of a first-order low-pass over a step: of its state, its input before, and its input after the step.

    The input is linear in between.

    Args:
        step: s.
        time: time constant, s.
    """
    if time == 0.0:
        return 0.0, 0.0, 1.0
    keep = np.exp(-step / time)
    mean = time * -np.expm1(-step / time) / step if step > 0 else 1.0
    return keep, mean - keep, 1.0 - mean
