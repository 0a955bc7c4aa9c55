"""Functions of small arrays, computed number by number, and every operation in a gpu_kernel."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_gpu_kernel import _pretended_gpu

from cfb_mjx.engine import gpu_kernel, scalars


def _apart(x) -> np.ndarray:
    array = np.empty(np.shape(x), object)
    for index in np.ndindex(array.shape):
        array[index] = np.asarray(x)[index]
    return array


def _moves(a, b):
    """Every operation that moves numbers, and calls within calls."""
    c = jnp.array([3.0, 1.0, 2.0], jnp.float32)
    stacked = jnp.stack([a[0], b], axis=1)
    joined = jnp.concatenate([a.reshape(-1), b, c])[1::2]
    turned = jax.lax.optimization_barrier((a.T, b))
    sums = [jnp.sum(a), jnp.sum(a, axis=0), jnp.sum(a[:, None] * a, axis=(0, 2))]
    chosen = jax.jit(lambda x: jax.jit(jnp.clip)(x, 0.0, 2.0))(turned[0])
    apart = [*jnp.unstack(a, axis=1), *jnp.unstack(b)]
    merged = [stacked, joined, chosen + turned[1][:, None], jnp.squeeze(a[:1], 0), jnp.float32(7.0) + 0 * b[0]]
    return [*merged, *apart, *sums]


def test_arrays_taken_apart_give_the_same():
    a, b = jnp.arange(6, dtype=jnp.float32).reshape(2, 3), jnp.array([4.0, -5.0, 6.0], jnp.float32)
    program = scalars.trace(lambda a, b, unused: _moves(a, b), a, b, a)
    assert program.used == (True, True, False)
    results = program(_apart(a), _apart(b), None)
    for got, expected in zip(results, _moves(a, b), strict=True):
        assert got.shape == expected.shape
        np.testing.assert_array_equal(got.astype(np.float64), expected)


def test_a_number_may_stand_for_many():
    a = jnp.arange(10, dtype=jnp.float32).reshape(5, 2)
    program = scalars.trace(lambda x, y: [x[0] * y + x[1]], a[0], a[0, 0])
    columns = np.empty(2, object)
    columns[:] = [a[:, 0], a[:, 1]]
    ((result,),) = (x.reshape(1) for x in program(columns, _apart(np.float32(2.0))))
    np.testing.assert_array_equal(result, 2 * a[:, 0] + a[:, 1])


def test_what_depends_on_what():
    program = scalars.trace(lambda a, b, c: [a + b, jnp.sin(c), jnp.float32(1.0)], *[jnp.float32(2.0)] * 3)
    assert scalars.changed_by(program, [1]) == [True, False, False]
    assert scalars.changed_by(program, [0, 2]) == [True, True, False]
    assert scalars.used(lambda x: [x[0] * x[2], jnp.cos(x[1])][:1], [1.0, 2.0, 3.0]) == [True, False, True]


@pytest.mark.parametrize("function", [jnp.sort, jnp.cumsum, lambda x: jax.jit(jnp.sort)(x)])
def test_unknown_operations_are_refused(function):
    assert scalars.trace(lambda x: [function(x)], jnp.arange(3.0)) is None


def test_unknown_operations_that_do_not_matter_are_left_out():
    def function(x):
        jnp.sort(x)
        return [x + 1]

    assert scalars.trace(function, jnp.arange(3.0)) is not None


def _everything(number, x, _command):
    """One step that uses every element-wise operation; two numbers of state would do the same twice."""
    small = jnp.tanh(x) * number
    terms = [jnp.abs(small), jax.lax.square(x), jnp.exp(small), jnp.expm1(small), jnp.log(x * x + 1), jnp.log1p(x * x)]
    terms += [jnp.sin(x), jnp.cos(x), jnp.tan(small), jnp.sqrt(x * x + 1), jax.lax.rsqrt(x * x + 1), jnp.sign(x)]
    terms += [x**3, jnp.abs(x) ** number, jnp.floor(x), jnp.ceil(x), jnp.maximum(x, 0.5), jnp.minimum(x, 0.5), -x]
    terms += [jax.lax.clamp(jnp.float32(-1.0), x, jnp.float32(1.0)), x - 1.0, x / 3.0]
    conditions = [x > 0, x >= 0, x < 1, x <= 1, x == 1, x != 1, jnp.isfinite(x), ~(x > 0)]
    conditions.append((x > 0) & (x < 1) | (x == 2))
    terms += [jnp.where(condition, x, number) for condition in conditions] + [conditions[0].astype(jnp.float32)]
    return [sum(weight * term for weight, term in enumerate(terms, 1)) / len(terms) ** 2]


@pytest.fixture
def everything():
    numbers = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in ((), (), (4,))]
    return scalars.trace(_everything, *numbers)


def _flown(program, start, **choices):
    number, commands = jnp.asarray(0.7, jnp.float32), jnp.zeros((1, 4), jnp.float32)
    tuning = gpu_kernel.Tuning(block=4)
    return gpu_kernel.fly(program, [number], [False], [start], commands, hold=2, every=1, tuning=tuning, **choices)[
        0, 0
    ]


def test_every_operation_computes_the_same_in_a_kernel(everything):
    known = {equation.primitive.name for equation in everything.traced.jaxpr.eqns}
    known |= {
        inner.primitive.name
        for equation in everything.traced.jaxpr.eqns
        if equation.primitive.name in scalars.CALLS
        for inner in equation.params["jaxpr"].jaxpr.eqns
    }
    assert known >= scalars.ELEMENTWISE
    start = jnp.linspace(-2.0, 3.0, 11, dtype=jnp.float32)
    once = jax.vmap(lambda x: _everything(jnp.float32(0.7), x, None)[0])
    np.testing.assert_allclose(_flown(everything, start, interpret=True), once(once(start)), rtol=1e-5, atol=1e-5)


@pytest.mark.filterwarnings("ignore:The Pallas Triton backend is deprecated:DeprecationWarning")
def test_every_operation_lowers_for_cuda(everything):
    start = jax.ShapeDtypeStruct((11,), jnp.float32)
    with _pretended_gpu():
        traced = jax.jit(lambda start: _flown(everything, start)).trace(start)
        assert traced.lower(lowering_platforms=("cuda",)).as_text().count("__gpu$xla.gpu.triton") == 1
