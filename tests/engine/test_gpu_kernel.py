"""The kernel of a rollout, carried out in plain JAX: what it computes, when it is chosen, and that CUDA can have it.

No test here needs a GPU. That the kernel compiles and computes the same on one is tried where one is, once per process
(`gpu.kernel_works`), and by `test_on_gpu.py`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools

import helpers
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cfb_mjx.engine import gpu, primitive
from cfb_mjx.engine.gpu import using
from cfb_mjx.engine.gpu_kernel import Tuning
from cfb_mjx.model import CATALOGUE, Effect, ParasiticDrag, Quadrotor, rollout, rollout_final
from cfb_mjx.model.effects.formula import ResidualFormula
from cfb_mjx.model.quadrotor import prepare
from cfb_mjx.model.rollout import SYSTEM, _rows, in_components
from cfb_mjx.model.state import stack
from cfb_mjx.model.vector import Vec

SMALL = Tuning(block=4)
"""So that a handful of drones takes several blocks, the last one partly filled."""


def _single(tree):
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), tree)


def _traced(way, function, *arguments):
    """Anew, as choices are made while tracing."""
    with using(way, SMALL):
        return jax.jit(lambda *a: function(*a)).trace(*arguments)


def _flown(way, function, *arguments):
    """Result of the function, carried out by the kernel or not."""
    traced = _traced(way, function, *arguments)
    assert _has_kernel(traced) == (way == "interpret")
    return traced.lower().compile(compiler_options=helpers.QUICK_COMPILE)(*arguments)


def _has_kernel(traced) -> bool:
    return any(equation.primitive.name == "pallas_call" for equation in _equations(traced.jaxpr.jaxpr))


def _equations(jaxpr):
    for equation in jaxpr.eqns:
        yield equation
        parameters = list(equation.params.values())
        for value in jax.tree.leaves(parameters, is_leaf=lambda x: hasattr(x, "eqns") or hasattr(x, "jaxpr")):
            inner = getattr(value, "jaxpr", value)
            if hasattr(inner, "eqns"):
                yield from _equations(inner)


def _assert_close(got, expected, share=2e-5):
    """Within a share of the largest entry: some steps' rounding of float32 (6e-8), which tumbling lets grow."""
    assert jax.tree.structure(got) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        assert a.dtype == jnp.float32
        np.testing.assert_allclose(a, b, rtol=0, atol=share * max(np.abs(b).max(), 1e-3))


def _spread(tree, count: int, seed: int = 0, share: float = 0.05):
    """Copies of a tree along a new leading axis, every number a little different."""
    random = np.random.default_rng(seed)
    return _single(jax.tree.map(lambda x: x * random.uniform(1 - share, 1 + share, (count, *x.shape)), tree))


@pytest.fixture(scope="module")
def model(off_center):
    return _single(Quadrotor(off_center, (ParasiticDrag(linear=[0.02, 0.03, 0.025], quadratic=0.01, cross=0.4),)))


@pytest.fixture(scope="module")
def flight():
    """A state and 12 commands in the middle of a flip."""
    y, commands = helpers.aggressive_manoeuvre(0.048)
    return _single((helpers.state_of(y), commands))


def _cases():
    """Function of (model, state, commands), and how many copies there are of each (0: no leading axis)."""
    held = functools.partial(rollout_final, hold=3)
    kept = functools.partial(rollout, hold=2, every=4)
    return {
        "one drone": (held, (0, 0, 0)),
        "own states and commands": (jax.vmap(held, in_axes=(None, 0, 2)), (0, 7, 7)),
        "own models, kept states": (jax.vmap(kept, in_axes=(0, None, None)), (5, 0, 0)),
        "own everything, one command": (jax.vmap(lambda m, s, u: rollout_final(m, s, u[:1], hold=9)), (8, 8, 8)),
        "models of states": (
            # A new function for jit in every trace, or it would remember the first way.
            jax.vmap(lambda *a: jax.jit(jax.vmap(kept, in_axes=(None, 0, None)))(*a), in_axes=(0, None, None)),
            (2, 3, 0),
        ),
        "three axes": (
            jax.vmap(jax.vmap(jax.vmap(held, (0, None, None)), (None, 0, None)), (None, None, 0), out_axes=1),
            (2, 3, 2),
        ),
    }


def _arguments(model, flight, counts):
    arguments = (model, *flight)
    return [_spread(x, n, i) if n else x for i, (x, n) in enumerate(zip(arguments, counts, strict=True))]


@pytest.mark.parametrize("name", _cases())
def test_kernel_equals_the_plain_program(name, model, flight):
    function, counts = _cases()[name]
    arguments = _arguments(model, flight, counts)
    if name == "own states and commands":
        arguments[2] = jnp.moveaxis(arguments[2], 0, 2)
    _assert_close(_flown("interpret", function, *arguments), _flown("plain", function, *arguments))


def test_kernel_is_as_exact_as_the_plain_program(model):
    """A second of flips, 250 steps: beside float64, the kernel is about as far off as plain float32 is."""
    y, commands = helpers.aggressive_manoeuvre(0.5, seed=3)
    models, flight = _spread(model, 6), _single((helpers.state_of(y), commands))
    fly = jax.vmap(functools.partial(rollout, hold=2, every=5), in_axes=(0, None, None))
    double = jax.tree.map(lambda x: jnp.asarray(np.asarray(x), jnp.float64), (models, *flight))
    exact, plain = _flown("plain", fly, *double), _flown("plain", fly, models, *flight)
    flown = _flown("interpret", fly, models, *flight)
    assert flown.position.shape == (6, 25, 3)
    assert exact.position.dtype == jnp.float64
    for name in helpers.NAMES:
        scale = np.abs(getattr(exact, name)).max()
        mine, theirs = (np.abs(getattr(x, name) - getattr(exact, name)).max() / scale for x in (flown, plain))
        print(f"{name}: kernel {mine:.1e}, plain {theirs:.1e}")
        assert mine < 3 * theirs + 1e-6, name
        assert theirs < 1e-3, name


def test_kernel_follows_the_ode(off_center):
    """Against SciPy's DOP853 on the paper's equations, which share nothing with the library."""
    y, commands = helpers.aggressive_manoeuvre(0.12, seed=1)
    truth = helpers.fly(helpers.constants_of(off_center), y, commands, 0.004)
    model = _single(Quadrotor(off_center, integrator="rk4", rotor_loads="instant"))
    states = _spread(helpers.state_of(y), 5, share=0.0)
    fly = jax.vmap(rollout, in_axes=(None, 0, None))
    for flown in helpers.pack(_flown("interpret", fly, model, states, _single(commands))):
        assert np.abs(helpers.part(flown - truth, "position")).max() < 2e-5
        assert np.abs(helpers.part(flown - truth, "velocity")).max() < 2e-4
        attitude = helpers.attitude_error(helpers.part(flown, "quaternion"), helpers.part(truth, "quaternion"))
        assert attitude.max() < 1e-4
        np.testing.assert_allclose(helpers.part(flown, "rotor_speed"), helpers.part(truth, "rotor_speed"), rtol=1e-5)


def _strong(kind: type[Effect]) -> Effect:
    middle = {key: 0.3 * low + 0.7 * high for key, (low, high) in kind.prior.items()}
    return kind(**middle)


def _all_effects(guards) -> Quadrotor:
    random = np.random.default_rng(1)
    formula = jax.tree.map(lambda x: 1e-5 * random.normal(size=x.shape), ResidualFormula.neutral())
    return _single(Quadrotor(guards, (*map(_strong, CATALOGUE.values()), formula)))


def test_every_effect_flies_in_the_kernel(guards, flight):
    """All at once; those that remember are compared in what they remember too."""
    model = _all_effects(guards)
    states = _spread(flight[0], 5)
    fly = jax.vmap(functools.partial(rollout_final, hold=2), in_axes=(None, 0, None))
    got, expected = (_flown(way, fly, model, states, flight[1]) for way in ("interpret", "plain"))
    assert len(jax.tree.leaves(expected.memory)) > 10
    _assert_close(got, expected)


def test_substeps_and_other_integrators_fly_in_the_kernel(model, flight):
    states = _spread(flight[0], 5)
    model = dataclasses.replace(model, integrator="rk4", rotor_loads="mean", substeps=2)
    fly = jax.vmap(rollout_final, in_axes=(None, 0, None))
    _assert_close(*(_flown(way, fly, model, states, flight[1]) for way in ("interpret", "plain")))


def _loss(model, state, commands):
    final = rollout_final(model, state, commands, hold=2)
    return sum(jnp.sum(x * jnp.arange(1, 1 + x.size, dtype=x.dtype)) for x in jax.tree.leaves(final)) / 1e3


def _derivatives():
    together = jax.vmap(_loss, in_axes=(None, 0, None))

    def total(*arguments):
        return together(*arguments).sum()

    def push(model, states, commands):
        direction = jax.tree.map(jnp.ones_like, commands)
        return jax.jvp(lambda u: together(model, states, u), (commands,), (direction,))

    return {
        "gradient of a batch": jax.grad(total, argnums=(0, 1, 2)),
        "batch of gradients": jax.vmap(jax.grad(_loss, argnums=2), in_axes=(None, 0, None)),
        "forward": push,
        "curvature": lambda m, s, u: jax.jvp(jax.grad(lambda x: total(m, s, x)), (u,), (jnp.ones_like(u),))[1],
    }


@pytest.mark.parametrize("name", _derivatives())
def test_derivatives_are_those_of_the_plain_program(name, model, flight):
    arguments = (model, _spread(flight[0], 3), flight[1][:3])
    function = _derivatives()[name]
    mine, plain = (_traced(way, function, *arguments) for way in ("interpret", "plain"))
    assert not _has_kernel(mine)
    # What stays constant is not differentiated: a gradient by the commands carries no tangents of the model.
    assert _count(mine) < 1.02 * _count(plain)
    if name == "curvature":  # compiles for half a minute to say the same
        return
    results = [x.lower().compile(compiler_options=helpers.QUICK_COMPILE)(*arguments) for x in (mine, plain)]
    _assert_close(*results, share=1e-6)


def _count(traced) -> int:
    return sum(1 for _ in _equations(traced.jaxpr.jaxpr))


class Remembers(Effect):
    """An effect whose memory is an array of three: no registers."""

    name = "remembers"

    def start(self, rotor_speed, parameters):
        return (Vec(jnp.zeros(3, jnp.float32)),)


class Sorts(Effect):
    """An effect that does what Triton cannot."""

    name = "sorts"

    def body(self, wrench, condition):
        return dataclasses.replace(wrench, torque=wrench.torque + jnp.sort(jnp.stack([*condition.body_rate]))[0] * 1e-6)


def test_what_the_kernel_cannot_do_stays_plain(model, flight, monkeypatch):
    state, commands = flight
    double = jax.tree.map(lambda x: x.astype(jnp.float64), (model, state, commands))
    plain = {
        "float64": double,
        "unknown operations": (dataclasses.replace(model, effects=(Sorts(),)), state, commands),
        "a few steps": (model, state, commands[:3]),
    }
    for name, arguments in plain.items():
        programs = [str(_traced(way, rollout_final, *arguments).jaxpr) for way in ("interpret", "plain")]
        assert programs[0] == programs[1], name
    remembers = dataclasses.replace(model, effects=(Remembers(),))
    assert gpu._step(SYSTEM, *_begun(remembers, state, commands), 4) is None
    assert gpu._step(SYSTEM, *_begun(model, state, commands), 4) is not None
    monkeypatch.setattr(gpu, "MOST_NUMBERS", 10)
    assert not _has_kernel(_traced("interpret", rollout_final, model, state, commands))


def _begun(model, state, commands):
    prepared = prepare(model)
    return prepared, jax.eval_shape(in_components, prepared, state, commands)


def test_nothing_changes_on_a_cpu(model, flight):
    """Without being told, a CPU gets the program it would have if there were no kernel."""

    def before(model, state, commands):
        prepared = prepare(model)
        final = primitive.fly(SYSTEM, model, in_components(prepared, state, commands), _rows(commands), 2)
        return stack(final, prepared.parameters.center_of_gravity)

    def before_kept(model, state, commands):
        prepared = prepare(model)
        kept = primitive.fly(SYSTEM, model, in_components(prepared, state, commands), _rows(commands), 2, every=4)
        return stack(kept, prepared.parameters.center_of_gravity)

    now = functools.partial(rollout_final, hold=2), functools.partial(rollout, hold=2, every=4)
    states = _spread(flight[0], 3)
    for new, old in zip(now, (before, before_kept), strict=True):
        for start, wrap in ((flight[0], lambda f: f), (states, functools.partial(jax.vmap, in_axes=(None, 0, None)))):
            programs = [jax.jit(lambda *a, f=wrap(f): f(*a)).lower(model, start, flight[1]) for f in (new, old)]
            assert programs[0].as_text() == programs[1].as_text()


class _Gpu:
    compute_capability = "8.6"


@pytest.mark.parametrize(
    ("changed", "suits"),
    [
        ({}, True),
        ({"default_backend": lambda: "cpu"}, False),
        ({"device_count": lambda: 2}, False),
        ({"devices": lambda: [type("Turing", (), {"compute_capability": "7.5"})]}, False),
        ({"devices": lambda: [type("Amd", (), {"compute_capability": "gfx90a"})]}, False),
        ({"devices": lambda: [object()]}, False),
    ],
)
def test_which_devices_suit(changed, suits, monkeypatch):
    suiting = {"default_backend": lambda: "gpu", "device_count": lambda: 1, "devices": lambda: [_Gpu]}
    for name, value in (suiting | changed).items():
        monkeypatch.setattr(jax, name, value)
    assert gpu._suits_kernel() is suits


def test_a_machine_with_a_gpu_still_computes_on_its_cpu(model, flight, monkeypatch):
    """The choice is the program's, made when it is known where it runs: here, though a GPU is claimed, on the CPU."""
    monkeypatch.setattr(gpu, "_suits_kernel", lambda: True)
    monkeypatch.setattr(gpu, "kernel_works", lambda: True)
    states = _spread(flight[0], 5)
    fly = jax.vmap(rollout_final, in_axes=(None, 0, None))
    arguments = (model, states, flight[1])
    traced = jax.jit(lambda *a: fly(*a)).trace(*arguments)
    assert _has_kernel(traced)
    _assert_close(
        traced.lower().compile(compiler_options=helpers.QUICK_COMPILE)(*arguments), _flown("plain", fly, *arguments)
    )
    monkeypatch.setattr(gpu, "kernel_works", lambda: False)
    assert not _has_kernel(jax.jit(lambda *a: fly(*a)).trace(*arguments))


def test_the_kernel_is_tried_before_it_is_used(monkeypatch):
    """In the middle of a trace, as it happens to users; one that fails or computes something else is not used."""
    tried = []

    def function(x):
        tried.append(gpu._tried("interpret", helpers.QUICK_COMPILE))
        return x * x

    jax.make_jaxpr(jax.vmap(jax.grad(function)))(jnp.ones(3))
    assert tried == [True]
    right = gpu.gpu_kernel.fly
    monkeypatch.setattr(gpu.gpu_kernel, "fly", lambda *a, **k: right(*a, **k) * 1.001)
    with pytest.warns(UserWarning, match="its results differ from the plain program's"):
        assert not gpu._tried("interpret", helpers.QUICK_COMPILE)
    monkeypatch.setattr(gpu.gpu_kernel, "fly", lambda *a, **k: 1 / 0)
    with pytest.warns(UserWarning, match="ZeroDivisionError"):
        assert not gpu._tried("interpret", helpers.QUICK_COMPILE)


@contextlib.contextmanager
def _pretended_gpu():
    """Newer versions of JAX want to know for which GPU a kernel is lowered."""
    if jax.__version_info__ < (0, 11):
        yield
        return
    from jax.sharding import AbstractDevice, AbstractMesh, use_abstract_mesh

    device = AbstractDevice(device_kind="NVIDIA A100", num_cores=None, platform="gpu")
    with use_abstract_mesh(AbstractMesh((), (), abstract_device=device)):
        yield


def _for_cuda(function, *arguments) -> str:
    with using("kernel"), _pretended_gpu():
        return jax.jit(lambda *a: function(*a)).trace(*arguments).lower(lowering_platforms=("cuda",)).as_text()


@pytest.mark.filterwarnings("ignore:The Pallas Triton backend is deprecated:DeprecationWarning")
@pytest.mark.parametrize("every", [None, 4])
def test_cuda_gets_one_kernel_and_no_loop(every, model, flight):
    fly = functools.partial(rollout, every=every) if every else rollout_final
    fly = jax.vmap(functools.partial(fly, hold=25), in_axes=(None, 0, None))
    states = _spread(flight[0], 300)
    text = _for_cuda(fly, model, states, flight[1])
    assert text.count("__gpu$xla.gpu.triton") == 1
    assert "stablehlo.while" not in text
    assert "grid_x = 3 : i32" in text
    # The loops are inside, with the 17 numbers of the state carried from step to step.
    with using("kernel"):
        program = jax.make_jaxpr(lambda *a: fly(*a))(model, states, flight[1])
    kernels = [e for e in _equations(program.jaxpr) if e.primitive.name == "pallas_call"]
    loops = [e for e in _equations(kernels[-1].params["jaxpr"]) if e.primitive.name == "scan"]
    assert [loop.params["length"] for loop in loops] == ([3, 4, 25] if every else [12, 25])
    assert all(sum(v.aval.shape == (128,) for v in loop.outvars) == 17 for loop in loops)


@pytest.mark.filterwarnings("ignore:The Pallas Triton backend is deprecated:DeprecationWarning")
def test_every_effect_lowers_for_cuda(guards, flight):
    fly = jax.vmap(rollout_final, in_axes=(None, 0, None))
    text = _for_cuda(fly, _all_effects(guards), _spread(flight[0], 5), flight[1])
    assert text.count("__gpu$xla.gpu.triton") == 1
    assert "stablehlo.while" not in text
