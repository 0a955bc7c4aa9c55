"""MuJoCo computes only the drones that may touch something; all fly as if it computed every one of them."""

from __future__ import annotations

import contextlib
from dataclasses import replace

import helpers
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from cfb_mjx.engine.batching import for_some
from cfb_mjx.errors import CfbError
from cfb_mjx.files import shipped
from cfb_mjx.model import MjxBody, MujocoBody, Quadrotor, rollout, rollout_final, scene_engines
from cfb_mjx.model.near import near
from cfb_mjx.model.randomised import sample_drone
from cfb_mjx.model.vector import Vec
from cfb_mjx.parameters import load_randomisation

# They share compiled programs.
pytestmark = pytest.mark.xdist_group("near")

SHAPES = """
<mujoco>
  <asset>
    <mesh name="pyramid" vertex="0.1 0.1 0.1  0.1 -0.1 -0.1  -0.1 0.1 -0.1  -0.1 -0.1 0.1"/>
    <hfield name="hills" nrow="3" ncol="3" size="0.5 0.4 0.2 0.1" elevation="0 1 0  1 0 1  0 1 0"/>
  </asset>
  <worldbody>
    <body pos="0.1 0.2 0" euler="0 0 30">
      <geom type="plane" size="1 1 1" euler="10 -20 0"/>
      <geom type="box" pos="0 0 1" size="0.3 0.02 0.1" euler="20 30 40" margin="0.05"/>
      <geom type="sphere" pos="1 0 1" size="0.1" margin="0.02" gap="0.03"/>
      <geom type="capsule" pos="-1 0 1" size="0.05 0.4" euler="50 10 0"/>
    </body>
    <geom type="cylinder" pos="0 1 1" size="0.2 0.3" euler="50 10 0"/>
    <geom type="ellipsoid" pos="0 -1 1" size="0.1 0.2 0.3" euler="0 40 10"/>
    <geom type="mesh" mesh="pyramid" pos="1 1 1" euler="20 0 70"/>
    <geom type="hfield" hfield="hills" pos="-1 -1 0.8"/>
    <geom name="pillar" type="box" pos="-1 1 1" size="0.1 0.1 0.3" contype="0" conaffinity="0" group="3"/>
  </worldbody>
  <contact><pair geom1="pillar" geom2="foot1" margin="0.2"/></contact>
</mujoco>
"""
FLOOR = '<geom name="floor" type="plane" size="0 0 1"/>'
HAZE = f'<mujoco><option density="1.2" viscosity="0.1"/><worldbody>{FLOOR}</worldbody></mujoco>'
WALL = '<geom type="box" pos="0.25 0 2" size="0.02 1 1"/>'
BODIES = pytest.mark.parametrize("kind", [MjxBody, MujocoBody])


@pytest.fixture(scope="module")
def drone():
    return Quadrotor.from_file("cfb-guards")


@pytest.mark.parametrize("world", ["floor of MJX", "floor", "shapes"])
def test_what_mujoco_finds_in_contact_is_near(world, write):
    if world == "shapes":
        body, low, high = MujocoBody(write(SHAPES, "shapes.xml")), (-2, -2, -0.5), (2, 2, 2.5)
    else:
        body, low, high = MujocoBody() if world == "floor" else MjxBody(), (-1, -1, -0.1), (1, 1, 0.4)
    model, random, count = body.mujoco_model, np.random.default_rng(3), 6000
    places, turned = random.uniform(low, high, (count, 3)), random.normal(size=(count, 4))
    data, touch = mujoco.MjData(model), np.zeros(count, bool)
    mujoco.mj_forward(model, data)
    around = data.geom_xpos[model.geom_bodyid != model.body("cfb").id]
    # Half of them anywhere, the others around the geoms.
    half = count // 2
    places[half:] = np.resize(around, (half, 3)) + random.normal(0.0, 0.15, (half, 3))
    seen = set()
    for i in range(count):
        data.qpos[:3], data.qpos[3:] = places[i], turned[i]
        mujoco.mj_forward(model, data)
        touch[i] = data.ncon > 0
        seen.update(data.contact.geom.ravel().tolist())
    assert touch.sum() > 100
    # Every geom of the world was touched.
    assert seen >= set(np.flatnonzero(model.geom_bodyid != model.body("cfb").id).tolist())
    for dtype in (np.float32, np.float64):
        found = jax.vmap(lambda x: near(body.around, Vec.unstack(x)))(jnp.asarray(places, dtype))
        assert not np.any(touch & ~np.asarray(found))
        assert np.mean(found[:half][~touch[:half]]) < 0.5


def _everywhere(body):
    """The same body, with MuJoCo's accelerations wherever the drone is."""
    body = type(body)(mjcf=body.mjcf)
    body.around = body.around._replace(everywhere=True)
    return body


def _fleet(drone: Quadrotor, places, velocity=(0.0, 0.0, 0.0)):
    """Randomised drones, their centres of gravity off their rotors' centres, tilted and turning."""
    ranges, random, count = load_randomisation("paper"), np.random.default_rng(1), len(places)
    drones = jax.vmap(lambda key: sample_drone(key, drone, ranges, 1.0))(jax.random.split(jax.random.key(2), count))
    states = jax.vmap(drone.hover_state)(jnp.asarray(places, float))
    turned = np.array([1.0, 0.0, 0.0, 0.0]) + random.normal(0.0, 0.2, (count, 4))
    states = replace(
        states,
        velocity=jnp.broadcast_to(jnp.asarray(velocity), (count, 3)),
        quaternion=jnp.asarray(turned / np.linalg.norm(turned, axis=1, keepdims=True)),
        body_rate=jnp.asarray(random.normal(0.0, 2.0, (count, 3))),
    )
    return drones, states


def _flown(body, drones, states, commands) -> np.ndarray:
    """Flights of a batch, (drones, steps, 17); nested if the arrays have two axes of drones."""

    def fly(drone, state):
        return rollout(replace(drone, body=body), state, commands)

    for _ in range(states.position.ndim - 1):
        fly = jax.vmap(fly)
    return helpers.pack(jax.jit(fly, compiler_options=helpers.QUICK_COMPILE)(drones, states))


HEIGHTS = [[0.0, 0.0, z] for z in (0.05, 3.0, 0.2, 2.0, 0.1, 5.0)]


@BODIES
def test_drones_near_and_far_fly_as_if_mujoco_computed_all(kind, drone):
    drones, states = _fleet(drone, HEIGHTS)
    body, commands = kind(), jnp.zeros((120, 4))
    found, expected = (_flown(each, drones, states, commands) for each in (body, _everywhere(body)))
    lowest = helpers.part(found, "position")[..., 2].min(axis=1)
    assert lowest[[0, 2, 4]].max() < 0.05
    assert lowest[[1, 3, 5]].min() > 0.5
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
    # Two axes of drones, of which only the states have both.
    nested = jax.tree.map(lambda x: x.reshape(2, 3, *x.shape[1:]), (drones, states))
    both = _flown(body, *nested, commands)
    np.testing.assert_allclose(both.reshape(found.shape), found, rtol=1e-9, atol=1e-9)


@BODIES
def test_a_drone_beside_a_wall_of_ones_own(kind, drone, write):
    text = (
        shipped("assets", "cfb.xml").read_text(encoding="utf-8").replace('<body name="cfb"', f'{WALL}<body name="cfb"')
    )
    body = kind(mjcf=write(text, "wall.xml"))
    drones, states = _fleet(drone, [[0.0, 0.0, 2.0], [0.0, 5.0, 2.0]], velocity=(2.5, 0.0, 0.0))
    commands = jnp.tile(drone.hover_command(), (80, 1))
    found, expected = (_flown(each, drones, states, commands) for each in (body, _everywhere(body)))
    x = helpers.part(found, "position")[..., 0].max(axis=1)
    assert x[0] < 0.2
    assert x[1] > 0.3
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


def test_what_else_acts_on_the_drone_acts_everywhere(drone, write):
    """MuJoCo's own drag is no contact; the closed form has none."""
    start = replace(drone.hover_state((0.0, 0.0, 50.0)), rotor_speed=jnp.zeros(4))
    ends = []
    for text in (HAZE, f"<mujoco><worldbody>{FLOOR}</worldbody></mujoco>"):
        with pytest.warns(match="drag") if "density" in text else contextlib.nullcontext():
            body = MujocoBody(write(text, f"{len(text)}.xml"))
        ends.append(float(rollout_final(replace(drone, body=body), start, jnp.zeros((250, 4))).velocity[2]))
    assert ends[1] == pytest.approx(-9.81, abs=0.1)
    assert ends[0] > -9.0


MOVED = '<body mocap="true" pos="-2 0 0.2"><geom type="box" size="0.3 0.3 0.02"/></body>'
MOTOR = '<actuator><general joint="free"/></actuator>'


@pytest.mark.parametrize("text", [f"<worldbody>{FLOOR}{MOVED}</worldbody>", f"<worldbody>{FLOOR}</worldbody>{MOTOR}"])
def test_a_world_with_moved_bodies_or_actuators_is_left_to_scenes(write, text):
    """Their poses and controls were missing in what MuJoCo was given, and all after them was off by so many numbers."""
    if "joint" in text:
        text = text.replace("</worldbody>", '<body name="cfb" pos="0 0 1"><freejoint name="free"/></body></worldbody>')
        text = text.replace("<freejoint", '<geom size="0.03" mass="0.04"/><freejoint')
    with pytest.raises(CfbError, match="use Scene for such a world"):
        MujocoBody(write(f"<mujoco>{text}</mujoco>", f"moved{len(text)}.xml"))


def test_the_host_is_called_for_those_near_alone(drone, monkeypatch):
    calls = []
    take = scene_engines._Worker.take
    monkeypatch.setattr(
        scene_engines._Worker, "take", lambda self, inputs, which: calls.append(len(which)) or take(self, inputs, which)
    )
    drones, states = _fleet(drone, [[0.0, 0.0, z] for z in (5.0, 6.0, 7.0)])
    _flown(MujocoBody(), drones, states, jnp.zeros((20, 4)))
    assert not calls
    _flown(MujocoBody(), *_fleet(drone, [[0.0, 0.0, z] for z in (5.0, 0.01, 7.0)]), jnp.zeros((3, 4)))
    assert calls == [1, 1, 1]


def test_forward_derivatives_are_those_of_mujoco_everywhere(drone):
    """Of a drone that flies and of one that lands, by their heights and by what their rotors do."""
    body, states = MjxBody(), _fleet(drone, [[0.0, 0.0, 0.03], [0.0, 0.0, 2.0]])[1]

    def ends(body):
        def end(height, scale, state):
            moved = replace(state, position=state.position + height * jnp.array([0.0, 0.0, 1.0]))
            commands = jnp.tile(scale * 0.5 * drone.hover_command(), (30, 1))
            flown = rollout_final(replace(drone, body=body), moved, commands)
            return jnp.concatenate([flown.position, flown.velocity, flown.quaternion, flown.body_rate])

        both = jax.vmap(jax.jacfwd(end, argnums=(0, 1)), in_axes=(None, None, 0))
        program = jax.jit(both, compiler_options=helpers.QUICK_COMPILE)
        return program(jnp.array(0.0), jnp.array(1.0), states)

    found, expected = ends(body), ends(_everywhere(body))
    assert np.abs(found[1]).max() > 0.1
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-8), found, expected)


def test_c_has_no_derivatives(drone):
    def end(height):
        start = drone.hover_state((0.0, 0.0, 1.0))
        start = replace(start, position=start.position * height)
        return rollout_final(replace(drone, body=MujocoBody()), start, jnp.zeros((2, 4))).position

    with pytest.raises(CfbError, match="MjxBody"):
        jax.jacfwd(end)(jnp.array(1.0))


@pytest.mark.parametrize("count", [1, 8, 9])
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_only_what_is_needed_is_computed_in_blocks(count, share):
    x, three = jnp.linspace(1.0, 2.0, count), jnp.array(3.0)
    needed = jnp.asarray(np.random.default_rng(count).uniform(size=count) < share)

    def one(needed, x, shared):
        # What only fills a block must not get into the results.
        return for_some(
            lambda real, x, y: [jnp.where(real, x**2 * y, jnp.nan), x * jnp.ones(2)], needed, [x, shared], 4
        )

    found = jax.jit(jax.vmap(one, in_axes=(0, 0, None)))(needed, x, three)
    np.testing.assert_allclose(found[0], np.where(needed, 3 * x**2, 0.0))
    np.testing.assert_allclose(found[1], np.where(needed, x, 0.0)[:, None] * np.ones(2))

    def third(needed, x):
        """Third derivative by x, of x to the power of four."""
        of = jax.jacfwd(jax.jacfwd(jax.jacfwd(lambda x: for_some(lambda _, x: [x**4], needed, [x], 4)[0])))
        return of(x)

    np.testing.assert_allclose(jax.vmap(third)(needed, x), np.where(needed, 24 * x, 0.0), rtol=1e-12)
    # The mask alone may differ between examples, or the arguments alone.
    np.testing.assert_allclose(
        jax.vmap(one, in_axes=(0, None, None))(needed, jnp.array(2.0), three)[0], np.where(needed, 12.0, 0.0)
    )
    np.testing.assert_allclose(jax.vmap(one, in_axes=(None, 0, None))(jnp.array(True), x, three)[0], 3 * x**2)
