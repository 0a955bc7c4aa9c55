"""Effects from outside the package: how they become known, what is refused, and that they fly as fast as any other."""

from __future__ import annotations

import textwrap
from functools import partial
from typing import ClassVar

import equinox as eqx
import helpers
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

from cfb_mjx.errors import CfbError
from cfb_mjx.model import CATALOGUE, Condition, Effect, Quadrotor, RigidBody, Wrench, begin, register, rollout, step
from cfb_mjx.model.effects import KNOWN, RotorDrag, effect_from_mapping, effect_to_mapping
from cfb_mjx.model.effects.fields import number, vector
from cfb_mjx.model.vector import Vec
from cfb_mjx.plugins import files, plugged
from tests.own_effect import AIR_DRAG


class Own(Effect):
    """F = -coefficient v."""

    name: ClassVar[str] = "own"
    units: ClassVar[dict[str, str]] = {"coefficient": "N s/m", "axes": "1"}
    prior: ClassVar[dict[str, tuple[float, float]]] = {"coefficient": (0.0, 0.1), "axes": (0.5, 2.0)}
    strengths: ClassVar[tuple[str, ...]] = ("coefficient",)
    probes: ClassVar[tuple[dict[str, float], ...]] = ({"axes": 1.0},)

    coefficient: Float[Array, "*batch"] = eqx.field(converter=number)
    axes: Float[Array, "*batch 3"] = eqx.field(converter=vector(3), default=1.0)

    @classmethod
    def neutral(cls):
        return cls(coefficient=0.0)

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        x, y, z = condition.velocity_body
        a, b, c = (-self.coefficient * self.axes[i] for i in range(3))
        return Wrench(wrench.force + Vec(a * x, b * y, c * z), wrench.torque)


def test_one_call_makes_an_effect_known_to_everything_that_goes_by_name():
    assert "own" not in CATALOGUE
    assert register(Own) is Own
    assert CATALOGUE["own"] is KNOWN["own"] is Own
    assert list(CATALOGUE)[-1] == "own"
    again = effect_from_mapping(effect_to_mapping(Own(0.02)), "drone.yaml")
    assert type(again) is Own
    np.testing.assert_array_equal(again.coefficient, 0.02)
    assert register(Own) is Own


def test_a_class_defined_anew_replaces_itself_and_no_other():
    register(Own)
    anew = type(Own)("Own", (Own,), {"__module__": Own.__module__, "__qualname__": "Own", "name": "own"})
    assert CATALOGUE["own"] is Own
    register(anew)
    assert CATALOGUE["own"] is anew
    with pytest.raises(CfbError, match=r"effect Thief: Own has the name 'own' already"):
        register(type(Own)("Thief", (Own,), {"name": "own"}))


def test_what_is_registered_within_a_block_is_forgotten_after_it():
    with plugged():
        register(Own)
        assert "own" in CATALOGUE
    assert "own" not in CATALOGUE


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"name": "Air Drag"}, "'name' must consist of lower-case letters"),
        ({"name": "rotor_drag"}, "RotorDrag has the name 'rotor_drag' already"),
        ({"name": "residual_formula"}, "ResidualFormula has the name"),
        ({"name": "sensor_delay"}, "a sensor fault has the name"),
        ({"name": "command_lead"}, "the search has the name"),
        ({"units": {"coefficient": "N s/m"}}, r"'units' must have an entry for each field \(coefficient, axes\)"),
        ({"prior": {"coefficient": (0.0, 0.1)}}, "'prior' must have an entry for each field"),
        ({"prior": {"coefficient": (0.1, 0.0), "axes": (0.5, 2.0)}}, "'prior' of coefficient must be two numbers"),
        ({"prior": {"coefficient": (0.01, 0.1), "axes": (0.5, 2.0)}}, "strength coefficient must be zero at neutral"),
        ({"strengths": "coefficient"}, "'strengths' must be a tuple"),
        ({"strengths": ("mass",)}, "'strengths' must be a tuple of the fields"),
        ({"probes": ({"coefficient": 0.1},)}, "'probes' must be a tuple"),
        ({"coarse": {1: 0.2}}, "the keys of 'coarse' must be indices of probes"),
        ({"neutral": Effect.neutral}, "'neutral' is missing"),
        ({"neutral": classmethod(lambda cls: cls(0.1))}, "strength coefficient must be zero at neutral"),
        ({"neutral": classmethod(lambda cls: RotorDrag(0.0))}, "'neutral' must return a Wrong"),
        ({"neutral": classmethod(lambda cls: cls(0.0, jnp.ones((2, 3))))}, "field axes must be an array"),
        ({"body": Effect.body}, "it changes nothing"),
    ],
)
def test_an_incomplete_effect_is_refused_by_a_sentence_that_names_it(changes, words):
    kind = type(Own)("Wrong", (Own,), changes)
    with pytest.raises(CfbError, match=f"^effect Wrong: .*{words}"):
        register(kind)
    assert "own" not in CATALOGUE


def test_what_is_no_effect_is_refused():
    for thing in (Own(0.0), int):
        with pytest.raises(CfbError, match="is not an effect"):
            register(thing)


@pytest.fixture
def plugin(tmp_path):
    path = tmp_path / "my_effects.py"
    path.write_text(AIR_DRAG)
    return path


def test_the_effects_of_a_file_are_known_inside_a_block(plugin):
    with plugged(plugin):
        assert files() == (plugin,)
        kind = CATALOGUE["air_drag"]
        assert kind.neutral().name == "air_drag"
    assert "air_drag" not in CATALOGUE
    assert files() == ()
    assert [p.name for p in plugin.parent.iterdir()] == ["my_effects.py"]
    # The same file again is the same class, so that what was compiled for it serves; another file is another.
    with plugged(plugin):
        assert CATALOGUE["air_drag"] is kind
    plugin.write_text(AIR_DRAG.replace("(0.0, 0.1)", "(0.0, 0.2)"))
    with plugged(plugin):
        assert CATALOGUE["air_drag"].prior["coefficient"] == (0.0, 0.2)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x = 1\n", "defines no effect"),
        ("x = 1\n1 / 0\n", r"cannot be loaded: ZeroDivisionError: division by zero \(line 2\)"),
        ("def f(:\n", "cannot be loaded: SyntaxError"),
        ("import sys\nsys.exit(3)\n", "cannot be loaded: SystemExit"),
        (AIR_DRAG.replace('"air_drag"', '"wind"'), "effect AirDrag: Wind has the name 'wind' already"),
        (AIR_DRAG.replace("    units", "    unit"), "effect AirDrag: 'units' must have an entry for each field"),
    ],
)
def test_a_file_that_is_no_plugin_is_refused_every_time_by_a_sentence(plugin, text, words):
    plugin.write_text(text)
    with plugged(plugin):
        for _ in range(2):
            with pytest.raises(CfbError, match=rf"my_effects\.py: .*{words}"):
                effect_from_mapping({"name": "air_drag"}, "drone.yaml")
    assert "wind" in CATALOGUE


def test_a_missing_file_is_refused_at_once(tmp_path):
    for name in ("none.py", "effects.txt"):
        with pytest.raises(CfbError, match=f"{name}: no such plugin"), plugged(tmp_path / name):
            pass


def test_a_file_may_bring_effects_of_other_modules_and_bases_of_its_own(plugin):
    more = """
    from cfb_mjx.model import CATALOGUE, RigidBody, register
    from cfb_mjx.model.effects import RotorDrag


    class Both(AirDrag):
        '''Derived.'''

        name = "more_drag"


    class Base(Effect):
        def body(self, wrench, condition):
            return wrench


    class Derived(Base):
        name, units, prior, strengths = "derived", AirDrag.units, AirDrag.prior, AirDrag.strengths
        coefficient: Float[Array, "*batch"] = eqx.field(converter=number)

        @classmethod
        def neutral(cls):
            return cls(coefficient=0.0)


    register(Derived)
    assert "rotor_drag" in CATALOGUE
    """
    plugin.write_text(AIR_DRAG + textwrap.dedent(more))
    with plugged(plugin):
        assert set(CATALOGUE) >= {"air_drag", "more_drag", "derived"}
        assert CATALOGUE["rotor_drag"] is RotorDrag


@pytest.mark.parametrize("value", ["my_package.effects:AirDrag", "my_package.effects"])
def test_an_installed_package_brings_its_effects(tmp_path, monkeypatch, value):
    (tmp_path / "my_package").mkdir()
    (tmp_path / "my_package" / "effects.py").write_text(AIR_DRAG)
    about = tmp_path / "my_package-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: my-package\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(f"[cfb_mjx.effects]\nair_drag = {value}\n")
    monkeypatch.syspath_prepend(tmp_path)
    with plugged(_some_file(tmp_path)):
        assert CATALOGUE["air_drag"].__module__ == "my_package.effects"
    (about / "entry_points.txt").write_text("[cfb_mjx.effects]\nair_drag = my_package.gone\n")
    with plugged(_some_file(tmp_path)), pytest.raises(CfbError, match=r"my-package, entry point .*ModuleNotFoundError"):
        list(CATALOGUE)


def _some_file(folder):
    """So that packages are looked at again."""
    path = folder / "other.py"
    path.write_text(AIR_DRAG.replace("AirDrag", "OtherDrag").replace("air_drag", "other_drag"))
    return path


# -- The fast path goes by what a step does ---------------------------------------------------------------------------


class MoreThanTriton(Own):
    """Functions that only the CPU's kernel has, and arithmetic on whole numbers, in a change of the drone as well."""

    name: ClassVar[str] = "more_than_triton"

    def change(self, parameters):
        return eqx.tree_at(lambda p: p.mass, parameters, parameters.mass * (1 + 0.01 * jnp.arctan2(self.axes[0], 2.0)))

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        x, y, z = condition.velocity_body
        bits = (jnp.asarray(100 * z, jnp.int32) ^ 5) % 7
        some = [jnp.arctan2(x, 1 + y * y), jnp.sinh(x), jnp.cosh(y), jnp.arcsinh(z), jax.scipy.special.erf(y)]
        some += [jax.nn.sigmoid(z), jnp.exp2(x), jnp.cbrt(1 + y * y), jnp.round(3 * x), jnp.arctan(z), 1.0 * bits]
        force = Vec(sum(some), x * y, -z)
        return Wrench(wrench.force + force * (self.coefficient * 0.1), wrench.torque)


class Matrix(Own):
    """A matrix product."""

    name: ClassVar[str] = "matrix"

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        velocity = jnp.stack([*condition.velocity_body])
        force = jnp.diag(self.axes) @ velocity * -self.coefficient
        return Wrench(wrench.force + Vec(*force), wrench.torque)


class Iterated(Own):
    """A loop."""

    name: ClassVar[str] = "iterated"

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        force = jax.lax.fori_loop(0, 3, lambda _, f: f - self.coefficient * condition.velocity_body, wrench.force)
        return Wrench(force, wrench.torque)


class MatrixInChange(Own):
    """A matrix product where the model is made ready."""

    name: ClassVar[str] = "matrix_in_change"

    def change(self, parameters):
        return eqx.tree_at(lambda p: p.inertia, parameters, jnp.diag(self.axes) @ parameters.inertia)


class RemembersArrays(Own):
    """A memory of arrays."""

    name: ClassVar[str] = "remembers_arrays"

    def start(self, rotor_speed, parameters):
        return (Vec(jnp.zeros(3, jnp.result_type(float))),)


class Table(Own):
    """More numbers than it pays to take apart."""

    name: ClassVar[str] = "table"
    table: Float[Array, "*batch n"] = eqx.field(converter=vector(300), default=1.0)

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        return Wrench(wrench.force + condition.velocity_body * (-self.coefficient * self.table.mean()), wrench.torque)


class Counted(Own):
    """Whole numbers as a field."""

    name: ClassVar[str] = "counted"
    count: Array = eqx.field(converter=jnp.asarray, default=3)

    def body(self, wrench: Wrench, condition: Condition) -> Wrench:
        return Wrench(wrench.force + condition.velocity_body * (-self.coefficient * (self.count % 2)), wrench.torque)


FAST = {"own": Own, "more": MoreThanTriton}
PLAIN = {kind.name: kind for kind in (Matrix, Iterated, MatrixInChange, RemembersArrays, Table, Counted)}


@pytest.fixture(scope="module")
def manoeuvre():
    y, commands = helpers.gentle_manoeuvre(0.048)
    return helpers.state_of(y), jnp.asarray(commands)


@partial(jax.jit, compiler_options=helpers.QUICK_COMPILE)
def _stepped(model, state, commands):
    def one(state, command):
        state = step(model, state, command)
        return state, state

    return jax.lax.scan(one, begin(model, state), commands)[1]


@pytest.mark.parametrize("kind", [*FAST.values(), *PLAIN.values()], ids=[*FAST, *PLAIN])
def test_an_effect_of_anybody_takes_the_fast_path_if_its_program_fits(kind, guards, manoeuvre):
    model = Quadrotor(guards, (kind(0.05),))
    fly = jax.vmap(lambda model, state, commands: rollout(model, state, commands), in_axes=(0, None, None))
    models = jax.tree.map(lambda x: jnp.stack([x, 1.01 * x]).astype(jnp.asarray(x).dtype), model)
    traced = jax.jit(fly).trace(models, *manoeuvre)
    in_groups = any(equation.primitive.name == "fly" for equation in traced.jaxpr.jaxpr.eqns)
    assert in_groups == (kind in FAST.values())
    flown = traced.lower().compile(compiler_options=helpers.QUICK_COMPILE)(models, *manoeuvre)
    for i in range(2):
        one = _stepped(jax.tree.map(lambda x, i=i: x[i], models), *manoeuvre)
        for got, wanted in zip(jax.tree.leaves(flown), jax.tree.leaves(one), strict=True):
            np.testing.assert_allclose(got[i], wanted, rtol=1e-9, atol=1e-9)
    without = rollout(Quadrotor(guards), *manoeuvre)
    assert np.abs(flown.position[0] - without.position).max() > 1e-7, "the test would not see it"


class Sliding:
    """Somebody's body: the rigid one, on a floor without friction that pulls it along x."""

    name = "sliding"

    def prepare(self, parameters, dt):
        return RigidBody().prepare(parameters, dt)

    def accelerations(self, prepared, state, wrench, gyroscopic=True):
        (x, y, z), angular = RigidBody().accelerations(prepared, state, wrench, gyroscopic)
        return Vec(x + 0.1, y, z), angular


def test_a_body_of_anybody_takes_the_fast_path_if_its_program_fits(guards, manoeuvre):
    model = Quadrotor(guards, body=Sliding())
    traced = jax.jit(rollout).trace(model, *manoeuvre)
    assert any(equation.primitive.name == "fly" for equation in traced.jaxpr.jaxpr.eqns)
    flown = traced.lower().compile(compiler_options=helpers.QUICK_COMPILE)(model, *manoeuvre)
    one = _stepped(model, *manoeuvre)
    np.testing.assert_allclose(flown.position, one.position, rtol=1e-9, atol=1e-9)
    assert np.abs(flown.position - rollout(Quadrotor(guards), *manoeuvre).position).max() > 1e-4


def test_the_choice_is_made_once_for_models_alike(guards):
    from cfb_mjx.model.rollout import _fits, fits_one_kernel

    assert fits_one_kernel(Quadrotor(guards, (Own(0.05),)))
    before = _fits.cache_info()
    assert fits_one_kernel(Quadrotor(guards, (Own(0.07),)))
    after = _fits.cache_info()
    assert (after.hits, after.misses) == (before.hits + 1, before.misses)


def test_what_has_no_hash_is_flown_plainly(guards):
    from cfb_mjx.model.rollout import fits_one_kernel

    class Listed(Own):
        name: ClassVar[str] = "listed"
        extra: set = eqx.field(default_factory=set)

    assert not fits_one_kernel(Quadrotor(guards, (Listed(0.05),)))
