"""Operations counted from a trace are those that are there."""

import jax
import jax.numpy as jnp
import pytest

from cfb_mjx.bench.roofline import operations

X = jnp.ones(10, jnp.float32)


def _loop(body, x, turns):
    return jax.lax.scan(lambda carry, _: (body(carry), None), x, length=turns)[0]


CASES = {
    "a multiply-add": (lambda x: 2 * x + 1, (X,), 20, 0),
    "tanh": (lambda x: jnp.tanh(x) * 2, (X,), 10, 10),
    "a product": (lambda a, b: a @ b, (jnp.ones((3, 4)), jnp.ones((4, 5))), 2 * 3 * 4 * 5, 0),
    "a loop": (lambda x: _loop(lambda y: y * y, x, 7), (X,), 70, 0),
    "a loop in a loop": (lambda x: _loop(lambda y: _loop(lambda z: z + 1, y, 3), x, 7), (X,), 210, 0),
    "the costlier branch": (lambda x: jax.lax.cond(x[0] > 0, lambda y: y + y, lambda y: y * y * y + 1, x), (X,), 30, 0),
    "integers do not count": (lambda x: jnp.arange(5) + 1, (X,), 0, 0),
    "compiled inside": (jax.jit(lambda x: x - 1), (X,), 10, 0),
    "a sum": (lambda x: jnp.sum(x), (X,), 10, 0),
    "computed again": (lambda x: jax.checkpoint(lambda y: y * y)(x), (X,), 10, 0),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_operations(case):
    function, arguments, plain, transcendental = CASES[case]
    found = operations(function, *arguments)
    assert (found.plain, found.transcendental) == (plain, transcendental)


def test_bytes_are_what_crosses_from_one_step_to_the_next():
    found = operations(lambda x: jax.lax.scan(lambda c, y: (c + y, c), x[0], x), jnp.ones((6, 10), jnp.float32))
    # Carry in and out, a row read, a row written, ten numbers of four bytes each.
    assert found.moved == 6 * 4 * 10 * 4
