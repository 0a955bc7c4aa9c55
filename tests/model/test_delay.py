"""The delay line: exact at its samples, linear between them, differentiable in the delay."""

from __future__ import annotations

import equinox as eqx
import helpers
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cfb_mjx.errors import CfbError
from cfb_mjx.model import DelayLine, State

DT = 0.004


def _line(values, longest=0.012):
    line = DelayLine.filled(jnp.asarray(values[0]), DT, longest)
    for value in values[1:]:
        line = line.push(jnp.asarray(value))
    return line


@pytest.mark.parametrize(
    ("delay", "expected"),
    [
        (0.0, 5.0),
        (0.004, 4.0),
        (0.008, 3.0),
        (0.012, 2.0),
        (0.005, 3.75),
        (0.0105, 2.375),
    ],
)
def test_reads_what_was_true_then(delay, expected):
    line = _line([0.0, 1.0, 2.0, 3.0, 4.0, 5.0])
    assert float(line.read(delay)) == pytest.approx(expected, abs=1e-12)
    assert float(jax.jit(DelayLine.read)(line, delay)) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("delay", [0.0121, 0.1, -0.1, -0.001, float("nan")])
def test_a_delay_outside_of_the_line_is_no_number(delay):
    line = _line([0.0, 1.0, 2.0, 3.0, 4.0, 5.0])
    with pytest.raises(CfbError, match=r"does not fit in a line of 0\.012 s"):
        line.read(delay)
    assert np.isnan(jax.jit(DelayLine.read)(line, delay))
    states = DelayLine.filled(_state(0.2), DT, 0.012)
    assert np.isnan(helpers.pack(jax.jit(DelayLine.read)(states, delay))).all()


def test_a_delay_of_the_whole_line_may_be_rounded():
    line = DelayLine.filled(jnp.float32(1.0), DT, 0.012)
    for value in (2.0, 3.0, 4.0):
        line = line.push(jnp.float32(value))
    assert line.read(jnp.float32(0.012) * (1 + 1e-6)) == 1.0


@pytest.mark.parametrize(("longest", "count"), [(0.0, 1), (0.004, 2), (0.008, 3), (0.0081, 4), (0.012, 4), (0.005, 3)])
def test_holds_as_many_samples_as_needed(longest, count):
    assert DelayLine.filled(jnp.zeros(2), DT, longest).samples.shape == (count, 2)


def test_a_filled_line_has_seen_its_sample_for_ever():
    sample = {"a": jnp.array([1.0, 2.0]), "b": (jnp.asarray(3.0),)}
    read = DelayLine.filled(sample, DT, 0.02).read(0.0137)
    jax.tree.map(np.testing.assert_allclose, read, sample)


def test_plain_pytrees_keep_structure_and_dtype():
    sample = {"a": jnp.array([1.0, 2.0], jnp.float32), "b": (jnp.asarray(3.0),)}
    line = DelayLine.filled(sample, DT, 0.008).push(jax.tree.map(lambda x: 3 * x, sample))
    read = line.read(0.002)
    assert jax.tree.structure(read) == jax.tree.structure(sample)
    assert read["a"].dtype == jnp.float32
    np.testing.assert_allclose(read["a"], [2.0, 4.0])
    np.testing.assert_allclose(read["b"][0], 6.0)


def test_integer_samples_are_not_lost():
    """A command counter or flag in the observation: exact at multiples of the step."""
    line = DelayLine.filled(jnp.array(1), DT, 0.008).push(jnp.array(5))
    assert float(line.read(0.0)) == 5
    assert float(line.read(0.004)) == 1
    assert float(line.read(0.002)) == 3


def _state(angle: float, sign: float = 1.0) -> State:
    y = np.zeros(17)
    y[:6] = angle
    y[6:10] = sign * np.array([np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0])
    return helpers.state_of(y)


@pytest.mark.parametrize("signs", [(1, 1), (1, -1), (-1, 1)])
def test_attitude_goes_the_shorter_way_whatever_the_signs(signs):
    line = DelayLine.filled(_state(0.2, signs[0]), DT, 0.008).push(_state(0.4, signs[1]))
    for delay, angle in ((0.0, 0.4), (0.004, 0.2), (0.002, 0.3)):
        read = line.read(delay)
        np.testing.assert_allclose(np.linalg.norm(read.quaternion), 1.0, rtol=1e-12)
        expected = helpers.part(helpers.pack(_state(angle)), "quaternion")
        assert helpers.attitude_error(np.asarray(read.quaternion), expected) < 1e-9
        np.testing.assert_allclose(read.position, angle, rtol=1e-12)


def test_a_state_inside_a_pytree_is_still_a_state():
    line = DelayLine.filled({"drone": _state(0.2, -1.0), "t": jnp.asarray(0.0)}, DT, 0.004)
    read = line.push({"drone": _state(0.4), "t": jnp.asarray(1.0)}).read(0.002)
    np.testing.assert_allclose(np.linalg.norm(read["drone"].quaternion), 1.0)
    assert float(read["t"]) == 0.5


def test_derivative_in_the_delay():
    line = _line([0.0, 1.0, 3.0, 7.0])
    for delay, slope in ((0.001, -4.0), (0.0055, -2.0), (0.011, -1.0)):
        assert float(jax.grad(line.read)(delay)) == pytest.approx(slope / DT, rel=1e-9)
        assert float(jax.jvp(line.read, (delay,), (1.0,))[1]) == pytest.approx(slope / DT, rel=1e-9)
    states = DelayLine.filled(_state(0.2), DT, 0.004).push(_state(0.4, -1.0))
    gradient = jax.grad(lambda d: states.read(d).quaternion[0])(0.001)
    assert np.isfinite(gradient)


def test_vmap_and_scan():
    lines = jax.vmap(lambda x: DelayLine.filled(x, DT, 0.008))(jnp.arange(3.0))

    def push_and_read(lines, x):
        lines = jax.vmap(DelayLine.push)(lines, x)
        return lines, jax.vmap(DelayLine.read)(lines, jnp.array([0.0, 0.004, 0.006]))

    _, read = jax.lax.scan(push_and_read, lines, jnp.arange(12.0).reshape(4, 3) + 10)
    np.testing.assert_allclose(read[:, 0], [10, 13, 16, 19])
    np.testing.assert_allclose(read[:, 1], [1, 11, 14, 17])
    np.testing.assert_allclose(read[:, 2], [2, 7, 13.5, 16.5])


def test_several_samples_at_once_are_pushed_oldest_first():
    line = _line([0.0, 1.0, 2.0, 3.0]).push_all(jnp.array([10.0, 11.0]))
    assert [float(line.read(i * DT)) for i in range(4)] == [11.0, 10.0, 3.0, 2.0]


def test_every_number_of_a_state_is_interpolated():
    """Also body rate, rotor speed and the memory of effects; a quarter of the way to the older sample."""
    still = np.concatenate([np.arange(1.0, 7.0), [1.0, 0.0, 0.0, 0.0], np.arange(10.0, 17.0)])
    change = np.concatenate([np.full(6, 4.0), np.zeros(4), np.full(7, 8.0)])
    older, newer = helpers.state_of(still), helpers.state_of(still + change)
    older, newer = (eqx.tree_at(lambda s: s.memory, s, (jnp.array([m]),)) for s, m in ((older, 20.0), (newer, 24.0)))
    read = DelayLine.filled(older, DT, DT).push(newer).read(DT / 4)
    np.testing.assert_allclose(helpers.pack(read), still + 0.75 * change, rtol=1e-12)
    np.testing.assert_allclose(read.memory[0], [23.0], rtol=1e-12)


def test_a_drone_upside_down_is_read_between_its_two_samples_whatever_came_after():
    """Turned by 3.0 and 3.3 rad at the two older samples, level at the newest."""
    line = DelayLine.filled(_state(3.3), DT, 2 * DT).push(_state(3.0)).push(_state(0.0))
    read = np.asarray(line.read(1.5 * DT).quaternion)
    assert helpers.attitude_error(read, helpers.part(helpers.pack(_state(3.15)), "quaternion")) < 1e-9
