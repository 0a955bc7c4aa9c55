"""Vector and quaternion algebra against SciPy's Rotation and NumPy, on random input."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cfb_mjx.model.vector import Vec, exponential, multiply, renormalise, rotate, rotate_inverse, up_axis

settings.register_profile("quick", max_examples=30, deadline=None, derandomize=True)
settings.load_profile("quick")

number = st.floats(-10, 10, allow_subnormal=False)
vector = st.tuples(number, number, number).map(np.array)
quaternion = (
    st.tuples(number, number, number, number)
    .map(np.array)
    .filter(lambda q: np.linalg.norm(q) > 1e-3)
    .map(lambda q: q / np.linalg.norm(q))
)


def _vec(array) -> Vec:
    return Vec.unstack(jnp.asarray(array))


def _scipy(q) -> Rotation:
    return Rotation.from_quat(np.asarray(q), scalar_first=True)


@given(quaternion, vector)
def test_rotate(q, v):
    np.testing.assert_allclose(rotate(_vec(q), _vec(v)).stack(), _scipy(q).apply(v), atol=1e-12)
    np.testing.assert_allclose(rotate_inverse(_vec(q), _vec(v)).stack(), _scipy(q).inv().apply(v), atol=1e-12)
    np.testing.assert_allclose(rotate_inverse(_vec(q), rotate(_vec(q), _vec(v))).stack(), v, atol=1e-12)
    np.testing.assert_allclose(up_axis(_vec(q)).stack(), _scipy(q).apply([0, 0, 1]), atol=1e-12)


@given(vector, vector)
def test_cross_dot_and_arithmetic(a, b):
    np.testing.assert_allclose(_vec(a).cross(_vec(b)).stack(), np.cross(a, b), atol=1e-12)
    np.testing.assert_allclose(_vec(a).dot(_vec(b)), a @ b, atol=1e-12)
    np.testing.assert_allclose(_vec(a).dot(tuple(b.tolist())), a @ b, atol=1e-12)
    np.testing.assert_allclose((_vec(a) + _vec(b) * 2 - (-_vec(a))).stack(), 2 * a + 2 * b, atol=1e-12)
    np.testing.assert_allclose((3 * _vec(a) / 2).stack(), 1.5 * a, atol=1e-12)
    np.testing.assert_allclose((1 + _vec(a)).stack(), 1 + a, atol=1e-12)
    np.testing.assert_allclose(_vec(a).sum(), a.sum(), atol=1e-12)


@given(quaternion, quaternion)
def test_product_composes_rotations(p, q):
    product = np.asarray(multiply(_vec(p), _vec(q)).stack())
    assert (_scipy(product) * (_scipy(p) * _scipy(q)).inv()).magnitude() < 1e-12


@given(vector)
def test_exponential(v):
    # One step turns by far less than pi / 2; the documented accuracy is asserted there and up to pi.
    angle = np.linalg.norm(v)
    for limit, tolerance in ((np.pi / 2, 1e-12), (np.pi, 1e-8)):
        rotation = v if angle <= limit else v / angle * limit
        q = exponential(_vec(rotation / 2)).stack()
        expected = Rotation.from_rotvec(rotation).as_quat(scalar_first=True, canonical=False)
        np.testing.assert_allclose(q, expected, atol=tolerance)
        assert np.linalg.norm(q) == pytest.approx(1.0, abs=2 * tolerance)


def test_exponential_is_smooth_at_zero():
    zero = jnp.zeros(3)
    jacobian = jax.jacfwd(lambda v: exponential(Vec.unstack(v)).stack())(zero)
    np.testing.assert_allclose(jacobian, np.vstack([np.zeros(3), np.eye(3)]), atol=1e-15)
    assert np.all(np.isfinite(jax.jacrev(lambda v: exponential(Vec.unstack(v)).stack())(zero)))


@given(st.tuples(number, number, number, number).map(np.array).filter(lambda q: np.linalg.norm(q) > 1e-3))
def test_renormalise(q):
    np.testing.assert_allclose(renormalise(_vec(q)).stack(), q / np.linalg.norm(q), rtol=1e-12, atol=1e-15)


@given(vector)
def test_known_zeros_cost_nothing_and_change_nothing(v):
    np.testing.assert_allclose(
        jnp.stack(jnp.broadcast_arrays(*Vec(0.0, 0.0, jnp.asarray(v[0])).cross(_vec(v)))),
        np.cross([0, 0, v[0]], v),
        atol=1e-12,
    )
    assert Vec(0.0, 0.0, 0.0).dot(_vec(v)) == 0.0
    np.testing.assert_allclose((_vec(v) + Vec(0.0, 0.0, 1.0)).stack(), v + np.array([0, 0, 1]))
    np.testing.assert_allclose((Vec(0.0, 0.0, 1.0) - _vec(v)).stack(), np.array([0, 0, 1]) - v)


def test_vec_is_an_immutable_pytree():
    v = _vec([1.0, 2.0, 3.0])
    with pytest.raises(AttributeError):
        v.components = ()
    assert jax.tree.map(lambda x: 2 * x, v).stack().tolist() == [2.0, 4.0, 6.0]
    with pytest.raises(ValueError, match="zip"):
        v + _vec([1.0, 2.0])
    batched = jnp.arange(6.0).reshape(2, 3)
    np.testing.assert_array_equal(Vec.unstack(batched).stack(), batched)
