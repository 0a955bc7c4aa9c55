"""Numbers of many keys are those of `jax.random`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cfb_mjx.engine.draws import normal

KEYS = jax.random.split(jax.random.PRNGKey(7), 12)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("shape", [(), (1,), (12,), (2, 6), (3, 1, 50)])
def test_normal_numbers_are_those_of_jax(shape, dtype):
    def ours(key):
        return normal(key, shape, dtype)

    def theirs(key):
        return jax.random.normal(key, shape, dtype)

    one, many, nested = KEYS[0], KEYS, KEYS.reshape(3, 4, 2)
    for draw in (lambda f: f(one), lambda f: jax.vmap(f)(many), lambda f: jax.vmap(jax.vmap(f))(nested)):
        found, wanted = jax.jit(lambda draw=draw: draw(ours))(), draw(theirs)
        assert found.dtype == wanted.dtype
        # The same bits; their erfinv is rounded differently where XLA joins it with other operations.
        np.testing.assert_allclose(found, wanted, rtol=3e-7, atol=1e-7)


def test_one_key_for_all_and_keys_of_another_kind():
    np.testing.assert_allclose(jax.vmap(lambda _: normal(KEYS[0], (3,)))(jnp.arange(4))[2], normal(KEYS[0], (3,)))
    typed = jax.random.key(3)
    np.testing.assert_array_equal(normal(typed, (5,)), jax.random.normal(typed, (5,), jnp.float32))
    with jax.threefry_partitionable(False):
        np.testing.assert_array_equal(normal(KEYS[0], (5,)), jax.random.normal(KEYS[0], (5,), jnp.float32))


def test_what_is_made_of_the_numbers_has_derivatives():
    def loss(scale, key):
        return jnp.sum(jnp.tanh(scale * normal(key, (6,))) ** 2)

    of_one = jax.grad(loss)(0.5, KEYS[0])
    together = jax.grad(lambda scale: jnp.sum(jax.vmap(loss, (None, 0))(scale, KEYS)))(0.5)
    each = [
        jax.grad(lambda s, k=key: jnp.sum(jnp.tanh(s * jax.random.normal(k, (6,), jnp.float32)) ** 2))(0.5)
        for key in KEYS
    ]
    assert float(of_one) == pytest.approx(float(each[0]), rel=1e-5)
    assert float(together) == pytest.approx(float(sum(each)), rel=1e-5)
