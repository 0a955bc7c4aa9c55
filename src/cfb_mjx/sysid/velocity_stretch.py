"""A velocity column that is too large: what its estimator did to a velocity, undone and done again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

LOOK, NOISE = 0.5, 0.015
"""Over so many seconds a position is held beside a velocity, and so far it errs meanwhile, m."""
BETWEEN, MOST = 0.1, 0.5
"""Standard deviation between flights of the share that was never flown, and the most it may be."""


@dataclass(frozen=True)
class VelocityStretch:
    """Logged velocity over true velocity, of motion of any frequency or of a band of it.

    An estimator whose velocity follows a stretched flow only slowly, and is in the end pulled back by what its position
    is corrected with, stretches neither quick nor slow motion: of the logged velocity v the share 1 - 1 / scale,
    lagged by ``rise`` and less the same lagged by ``fade`` once more, was never flown.

    Attributes:
        scale: (3,) along the world's axes, where it is largest; or such of every row or window.
        rise: s; 0: at once.
        fade: s; None: never.
    """

    scale: np.ndarray
    rise: float = 0.0
    fade: float | None = None

    @property
    def none(self) -> bool:
        """Whether velocity is logged as it was."""
        return bool((self.scale == 1.0).all())

    @property
    def constant(self) -> bool:
        """Whether all motion is stretched alike, so that no row needs another."""
        return self.none or (self.rise == 0.0 and self.fade is None)

    def memory(self, time: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """What the estimator carries at every row, (N, 2, 3), from times (N,) and logged velocities (N, 3); its
        history before the first row was like that row."""
        if self.constant:
            return np.zeros((len(time), 2, 3))
        first = velocity[0], np.zeros(3) if self.fade is None else velocity[0]
        return self.carried(np.stack(first)[None], np.diff(time), velocity[None])[0]

    def undone(self, time: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """True velocities, (N, 3), of logged ones; every row rests on itself and earlier ones."""
        if self.constant:
            return velocity / self.scale
        slow, slower = np.moveaxis(self.memory(time, velocity), 1, 0)
        return velocity - self._share * (slow - slower)

    def done(self, memory: np.ndarray, step: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """What is logged, (W, H + 1, 3), of true velocities of the same shape that follow each other by steps (H,), s.

        Args:
            memory: (W, 2, 3) at the first of them.
        """
        if self.constant:
            return velocity * self.scale
        slow, slower = memory[:, 0], memory[:, 1]
        logged = [velocity[:, 0] + self._share * (slow - slower)]
        for i, h in enumerate(step):
            # Logged velocity depends on both lags at the end of the step, and they on it: three linear equations.
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
        """`memory` along logged velocities (W, H + 1, 3) that follow each other by steps (H,), s: (W, H + 1, 2, 3).

        Args:
            memory: (W, 2, 3) at the first of them.
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
        """Positions (..., 3) that move as the logged velocity says; what the stretch adds to them is bounded by what
        its lags hold (..., 2, 3), or grows with the position where it never fades."""
        if self.fade is None:
            return self.scale * (position - self._share * self.rise * memory[..., 0, :])
        return position + self._share * self.fade * memory[..., 1, :]

    def left(self, followed: np.ndarray, memory: np.ndarray) -> np.ndarray:
        """The inverse of `followed`."""
        if self.fade is None:
            return followed / self.scale + self._share * self.rise * memory[..., 0, :]
        return followed - self._share * self.fade * memory[..., 1, :]

    def learned(self, time: np.ndarray, velocity: np.ndarray, position: np.ndarray) -> np.ndarray:
        """Horizontal scale of this flight as it is known at every row, (N, 3), from that row and earlier ones.

        Over `LOOK` seconds the position moves less than the velocity says, by the share that was never flown times what
        the lags carried meanwhile. The scale of other flights is where it begins; how far flights differ and how well
        a position tells are `BETWEEN` and `NOISE`.

        Args:
            time: (N,) s.
            velocity: (N, 3) as logged, world.
            position: (N, 3) as logged.
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
        # Windows overlap: each row adds what one of them says, in the share that is new.
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
    """What a lagged value takes over a step of itself, of its input before and of its input after (linear between)."""
    if time == 0.0:
        return 0.0, 0.0, 1.0
    keep = np.exp(-step / time)
    mean = time * -np.expm1(-step / time) / step if step > 0 else 1.0
    return keep, mean - keep, 1.0 - mean
