"""Scenes: a user's MJCF with the drone, in MJX and in MuJoCo's C."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cfb_mjx.errors import CfbError, CfbWarning
from cfb_mjx.files import shipped
from cfb_mjx.model import MjxBody, Quadrotor, Scene, State, rollout
from cfb_mjx.model.effects import Downwash
from cfb_mjx.model.randomised import sample_drone
from cfb_mjx.model.scene_camera import geom_names, look
from cfb_mjx.model.swarm import rollout_swarm
from cfb_mjx.parameters import load_randomisation

WORLD = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <geom name="bar" type="box" pos="0.5 0 1" size="0.02 0.3 0.02"/>
    <body name="ball" pos="3 0 1"><freejoint/><geom type="sphere" size="0.05" mass="0.02"/></body>
    <body name="platform" mocap="true" pos="-2 0 0.2"><geom type="box" size="0.3 0.3 0.02"/></body>
  </worldbody>
</mujoco>
"""
LOADED = """
<mujoco>
  <worldbody>
    <body name="cfb" pos="0 0 1"><site name="hook" pos="0 0 -0.01"/></body>
    <body name="load" pos="0 0 0.79"><freejoint/>
      <geom type="sphere" size="0.01" mass="0.006" contype="0" conaffinity="0" group="3"/><site name="eye"/></body>
  </worldbody>
  <tendon><spatial name="cable" limited="true" range="0 0.2"><site site="hook"/><site site="eye"/></spatial></tendon>
</mujoco>
"""
SEEN = """
<mujoco>
  <worldbody>
    <camera name="above" pos="0 0 5" xyaxes="1 0 0 0 1 0"/>
    <geom name="floor" type="plane" size="0 0 1"/>
    <geom name="wall" type="box" pos="3 0 5" size="1 4 5"/>
    <geom name="ball" type="sphere" pos="1 0.2 1" size="0.1"/>
    <body name="cfb"><camera name="front" pos="0.03 0 0" xyaxes="0 -1 0 0 0 1" fovy="60"/></body>
    <body name="other" pos="5 5 0.2"><freejoint/><geom type="sphere" size="0.05" mass="0.02"/></body>
  </worldbody>
</mujoco>
"""
ENGINES = ("mjx", "c")
BY_THEMSELVES = not os.environ.get("PLAIN_XLA")
"""jaxlib 0.10 aborts while it compiles contacts with the option of `cfb_mjx.runtime.XLA_CPU_FLAGS`."""
mjx = pytest.mark.skipif(BY_THEMSELVES, reason="runs in a process of its own: see the first test")
QUICK = {"xla_backend_optimization_level": 0}


@pytest.mark.skipif(not BY_THEMSELVES, reason="is this process")
def test_scenes_in_a_process_of_their_own():
    plain = {key: value for key, value in os.environ.items() if key != "XLA_FLAGS"} | {"PLAIN_XLA": "1"}
    command = [sys.executable, "-m", "pytest", "-n0", "-rs", __file__]
    done = subprocess.run(command, env=plain, capture_output=True, text=True, check=False)
    assert "1 skipped" in done.stdout, done.stdout + done.stderr
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.fixture(scope="module")
def drone():
    return Quadrotor.from_file("cfb-guards", dt=0.002, integrator="euler")


@pytest.fixture(scope="module")
def worlds(write, drone):
    """The world in both engines, and a compiled rollout of each."""
    path = write(WORLD, "world.xml")
    found = {engine: Scene(path, engine) for engine in ENGINES}
    fly = {e: jax.jit(scene.rollout, compiler_options=QUICK) for e, scene in found.items()}
    return found, fly


def _commands(drone: Quadrotor, steps: int = 400) -> jax.Array:
    return jnp.tile(drone.hover_command(), (steps, 1))


@mjx
@pytest.mark.parametrize("engine", ENGINES)
def test_far_from_everything_it_flies_as_without_a_scene(worlds, drone, engine):
    scenes, fly = worlds
    commands = _commands(drone) * jnp.array([1.02, 1.0, 1.01, 0.99])
    start = drone.hover_state((0.0, 5.0, 1.0))
    flown = fly[engine](drone, scenes[engine].begin(drone, start), commands).drone
    alone = rollout(drone, start, commands)
    for name in ("position", "velocity", "quaternion", "body_rate", "rotor_speed"):
        np.testing.assert_allclose(getattr(flown, name), getattr(alone, name), rtol=1e-9, atol=1e-9)


@mjx
@pytest.mark.parametrize("engine", ENGINES)
def test_a_bar_stops_the_drone_and_bodies_fall(worlds, drone, engine):
    scenes, fly = worlds
    start = replace(drone.hover_state((0.2, 0.0, 1.0)), velocity=jnp.array([1.0, 0.0, 0.0]))
    flown = fly[engine](drone, scenes[engine].begin(drone, start), _commands(drone))
    x = np.asarray(flown.drone.position[:, 0])
    # Its outline reaches 0.067 m ahead of its centre, the bar begins at 0.48 m.
    assert 0.40 < x.max() < 0.425
    assert np.abs(flown.constraint).max() > 0.1
    ball = np.asarray(flown.positions[:, 2])
    np.testing.assert_allclose(ball[99], 1 - 9.81 * 0.2**2 / 2, atol=0.003)


@mjx
@pytest.mark.parametrize("engine", ENGINES)
def test_a_platform_carries_the_drone(worlds, drone, engine):
    scenes, fly = worlds
    state = scenes[engine].begin(drone, drone.hover_state((-2.0, 0.0, 0.2345)))
    state = replace(state, drone=replace(state.drone, rotor_speed=jnp.zeros(4)))
    off = jnp.zeros((400, 4))
    landed = jax.tree.map(lambda x: x[-1], fly[engine](drone, state, off))
    height = float(landed.drone.position[2]) - 0.22
    assert 0.010 < height < 0.015
    for lift in (0.0004, 0.0008, 0.0012):
        up = replace(landed, mocap_positions=jnp.array([[-2.0, 0.0, 0.2 + 3 * lift]]))
        landed = jax.tree.map(lambda x: x[-1], fly[engine](drone, up, off))
    assert float(landed.drone.position[2]) == pytest.approx(0.2236 + height, abs=5e-4)


@mjx
def test_both_engines_fly_randomised_drones_alike(worlds, drone):
    scenes, _ = worlds
    ranges = load_randomisation("paper")
    drones = jax.vmap(lambda key: sample_drone(key, drone, ranges, 1.0))(jax.random.split(jax.random.PRNGKey(1), 3))
    start = replace(drone.hover_state((0.3, 0.0, 1.0)), velocity=jnp.array([1.0, 0.0, 0.0]))
    commands = _commands(drone, 150)
    found = []
    for engine in ENGINES:
        scene = scenes[engine]

        def fly(drone, scene=scene):
            return scene.rollout(drone, scene.begin(drone, start), commands)

        found.append(jax.jit(jax.vmap(fly), compiler_options=QUICK)(drones).drone)
    assert np.ptp(found[0].position[:, -1], axis=0).max() > 0.01
    before = 50
    np.testing.assert_allclose(found[0].position[:, :before], found[1].position[:, :before], rtol=1e-9, atol=1e-9)
    # The two find other points of contact between a capsule and an edge; both stop the drone at the same place.
    reached = [np.asarray(each.position[..., 0]).max(axis=1) for each in found]
    np.testing.assert_allclose(*reached, atol=0.01)


@mjx
@pytest.mark.parametrize("engine", ENGINES)
def test_a_cable_carries_a_load(write, drone, engine):
    scene = Scene(write(LOADED, "loaded.xml"), engine)
    state = scene.begin(drone, drone.hover_state((0.0, 0.0, 1.0)))
    commands = _commands(drone, 500)
    flown = jax.jit(scene.rollout, compiler_options=QUICK)(drone, state, commands)
    # With the thrust of a hover without load, both fall together as (m + M) a = m g.
    total, load = 0.05, 0.006
    fallen = load / total * 9.81
    hook, eye = np.asarray(flown.drone.position) - [0, 0, 0.01], np.asarray(flown.positions[:, :3])
    assert np.linalg.norm(hook - eye, axis=1).max() < 0.205
    np.testing.assert_allclose(flown.drone.velocity[-1, 2], -fallen * 1.0, rtol=0.02)
    # The cable pulls with what the load weighs in the falling frame.
    np.testing.assert_allclose(np.mean(flown.constraint[200:, 2]), -load * (9.81 - fallen), rtol=0.02)


@mjx
def test_a_camera_sees_depth_and_what_it_is(write, drone):
    path = write(SEEN, "seen.xml")
    start = drone.hover_state((0.0, 0.0, 1.0))
    seen = {}
    for engine in ENGINES:
        scene = Scene(path, engine)
        state = scene.begin(drone, start)
        seen[engine] = jax.jit(lambda state, s=scene: look(s, drone, state, "front", 33, 25))(state)
        names = geom_names(scene)
    depth, geom = (np.asarray(x) for x in seen["mjx"])
    np.testing.assert_allclose(depth, seen["c"].depth, rtol=1e-9)
    np.testing.assert_array_equal(geom, seen["c"].geom)
    # Straight ahead the wall, 2 m from the drone and 0.03 m less from the camera; depth, not distance, to its edge.
    assert names[geom[12, 16]] == "wall"
    np.testing.assert_allclose(depth[[12, 0, 0], [16, 16, 0]], 1.97)
    # The ball, 0.2 m to the left at 0.97 m: eleven degrees, of the 2.4 that a pixel has in the middle.
    columns = np.unique(np.nonzero(geom == names.index("ball"))[1])
    pixel = 2 * np.tan(np.radians(30)) / 25
    assert abs(columns.mean() - (16 - 0.2 / 0.97 / pixel)) < 0.6
    assert depth[12, round(columns.mean())] == pytest.approx(0.87, abs=0.01)
    # In the last row the floor, 1 m below: its depth is 1 over the tangent of the angle.
    assert names[geom[24, 16]] == "floor"
    assert depth[24, 16] == pytest.approx(1 / (12 * pixel))


@mjx
def test_many_drones_look_at_once(write, drone):
    for engine in ENGINES:
        scene = Scene(write(SEEN, "seen.xml"), engine)
        states = [scene.begin(drone, drone.hover_state((x, 0.0, 1.0))) for x in (0.0, 0.5, 0.7)]
        states = jax.tree.map(lambda *x: jnp.stack(x), *states)
        seen = jax.jit(jax.vmap(lambda state, s=scene: look(s, drone, state, "front", 3, 3)))(states)
        np.testing.assert_allclose(seen.depth[:, 1, 1], [1.97, 1.47, 1.27], rtol=1e-6)
        with pytest.raises(CfbError, match="has no camera 'back'; its cameras: above, front"):
            look(scene, drone, states, "back")


@mjx
def test_a_box_in_a_copy_of_our_file_stops_the_drone(write, guards):
    """A copy with a box used to be flown through, because the file's default had no contact."""
    box = '<geom name="box" type="box" pos="0 0 0.5" size="0.2 0.2 0.02"/>\n    <body name="cfb"'
    text = shipped("assets", "cfb.xml").read_text(encoding="utf-8").replace('<body name="cfb"', box)
    model = Quadrotor(guards, body=MjxBody(mjcf=write(text, "box.xml")))
    start = model.hover_state((0.0, 0.0, 0.7))
    flown = jax.jit(rollout, compiler_options=QUICK)(model, start, jnp.zeros((150, 4)))
    assert 0.52 < float(flown.position[-1, 2]) < 0.54


def _side_by_side(drone: Quadrotor, places, velocities=0.0) -> tuple[Quadrotor, State]:
    places = jnp.asarray(places)
    hover = jax.vmap(drone.hover_state)(places)
    velocities = jnp.broadcast_to(jnp.asarray(velocities), places.shape)
    return jax.tree.map(lambda x: jnp.stack([x] * len(places)), drone), replace(hover, velocity=velocities, memory=())


@mjx
@pytest.mark.parametrize("engine", ENGINES)
def test_drones_collide(write, drone, engine):
    scene = Scene(write("<mujoco/>", "empty.xml"), engine, drones=2)
    drones, start = _side_by_side(drone, [[0.0, 0.0, 1.0], [0.25, 0.0, 1.0]], [[0.5, 0.0, 0.0], [-0.5, 0.0, 0.0]])
    commands = jnp.broadcast_to(drone.hover_command(), (150, 2, 4))
    flown = jax.jit(scene.rollout, compiler_options=QUICK)(drones, scene.begin(drones, start), commands)
    apart = np.asarray(flown.drone.position[:, 1, 0] - flown.drone.position[:, 0, 0])
    # Their outlines reach 0.067 m from their centres.
    assert 0.125 < apart.min() < 0.135
    assert apart[-1] > 0.15
    # What the one is pushed the other is pushed back.
    force = np.asarray(flown.constraint)[..., :3]
    assert np.abs(force[:, 0, 0]).max() > 0.5
    np.testing.assert_allclose(force[:, 0], -force[:, 1], atol=1e-6)


@mjx
@pytest.mark.parametrize("count", [2, 6])
def test_wakes_in_a_scene_are_those_of_a_swarm(write, drone, count):
    drone = replace(drone, effects=(Downwash(coefficient=0.004),))
    scene = Scene(write("<mujoco/>", "empty.xml"), "c", drones=count)
    places = [[0.05 * i, 3.0 * (i // 2), 1.5 - 0.5 * (i % 2)] for i in range(count)]
    drones, start = _side_by_side(drone, places)
    commands = jnp.broadcast_to(drone.hover_command(), (100, count, 4))
    flown = jax.jit(lambda state: scene.rollout(drones, state, commands, every=50))(scene.begin(drones, start)).drone
    swarm = rollout_swarm(drones, start, commands, every=50).state
    assert float(swarm.position[-1, 1, 2]) < 0.985
    # A swarm of more than four exchanges its states every 20 ms.
    np.testing.assert_allclose(flown.position, swarm.position, atol=1e-9 if count == 2 else 2e-4)
    np.testing.assert_allclose(flown.quaternion, swarm.quaternion, atol=1e-9 if count == 2 else 2e-3)


@mjx
def test_a_drone_sees_another(write, drone):
    text = SEEN.replace('<body name="cfb">', '<body name="cfb1">')
    for engine in ENGINES:
        scene = Scene(write(text, "two.xml"), engine, drones=2)
        drones, start = _side_by_side(drone, [[0.7, 0.0, 1.0], [0.0, 0.0, 1.0]])
        seen = look(scene, drones, scene.begin(drones, start), "front", 3, 3)
        # The back of the other's outline, 0.067 m from its centre.
        assert float(seen.depth[1, 1]) == pytest.approx(0.67 - 0.067, abs=0.006)


@mjx
@pytest.mark.parametrize("engine", ENGINES)
def test_several_drones_meet_every_shape_of_the_world(write, drone, engine):
    """MJX looked at the nearest pairs only, by their bounding spheres: a large box was nearer than all others."""
    floor = '<geom type="box" pos="0 0 -0.1" size="10 10 0.1"/><geom type="box" pos="0 0 0.5" size="0.1 0.1 0.1"/>'
    scene = Scene(write(f"<mujoco><worldbody>{floor}</worldbody></mujoco>", "boxes.xml"), engine, drones=2)
    drones, start = _side_by_side(drone, [[0.0, 0.0, 0.63], [2.0, 0.0, 1.0]])
    start = replace(start, rotor_speed=jnp.zeros((2, 4)))
    commands = jnp.zeros((100, 2, 4))
    fly = jax.jit(lambda state: scene.rollout(drones, state, commands, every=100), compiler_options=QUICK)
    assert float(fly(scene.begin(drones, start)).drone.position[-1, 0, 2]) == pytest.approx(0.614, abs=0.003)


def test_drones_that_do_not_fit_a_scene_are_refused(write, drone):
    scene = Scene(write("<mujoco/>", "empty.xml"), "c", drones=3)
    drones, start = _side_by_side(drone, [[0.0, 0.0, 1.0], [1.0, 0.0, 1.0]])
    with pytest.raises(CfbError, match=r"there are 3, the mass has shape \(2,\)"):
        scene.begin(drones, start)
    scene = Scene(write("<mujoco/>", "empty.xml"), "c", drones=2)
    uneven = replace(drones, parameters=replace(drones.parameters, gravity=jnp.array([9.81, 1.62])))
    with pytest.raises(CfbError, match="one gravity"):
        scene.begin(uneven, start)
    with pytest.raises(CfbError, match="at least 1, found 0"):
        Scene(write("<mujoco/>", "empty.xml"), "c", drones=0)
    with pytest.raises(CfbError, match=r"its 2 drones; the position has shape \(1, 3\)"):
        scene.begin(drones, jax.tree.map(lambda x: x[:1], start))
    with pytest.raises(CfbError, match="repeated name 'foot11'"):
        Scene(write('<mujoco><worldbody><geom name="foot11" size="1"/></worldbody></mujoco>', "foot.xml"), drones=2)
    # A copy of assets/cfb.xml from before drones met each other.
    before = shipped("assets", "cfb.xml").read_text(encoding="utf-8")
    before = before.replace('contype="8" conaffinity="9"', 'contype="0" conaffinity="1"')
    with pytest.warns(CfbWarning, match="the drones fly through each other"):
        Scene(write(before, "before.xml"), "c", drones=2)
    ghosts = "".join(f'<body name="{n}"><freejoint/><geom size="0.05" mass="1"/></body>' for n in ("cfb", "cfb1"))
    ghosts = ghosts.replace("<geom", '<geom contype="0" conaffinity="0"')
    with pytest.warns(CfbWarning, match="the drones fly through each other"):
        Scene(write(f"<mujoco><worldbody>{ghosts}</worldbody></mujoco>", "ghosts.xml"), "c", drones=2)


def test_what_is_flown_through_is_said(write):
    text = WORLD.replace('name="bar"', 'name="bar" contype="0" conaffinity="0"')
    with pytest.warns(CfbWarning, match="flies through geom 'bar'"):
        Scene(write(text, "through.xml"))


@mjx
@pytest.mark.parametrize("engine", ENGINES)
def test_a_touch_between_two_returned_states_is_not_lost(worlds, drone, engine):
    """Another project's gate was hit, and the one state that was returned after it said that nothing was touched."""
    scene = worlds[0][engine]
    start = replace(drone.hover_state((0.35, 0.0, 1.0)), velocity=jnp.array([1.0, 0.0, 0.0]))
    commands = _commands(drone, 200)
    fly = jax.jit(lambda state: scene.rollout(drone, state, commands, every=100), compiler_options=QUICK)
    flown = fly(scene.begin(drone, start))
    touched = np.abs(np.asarray(flown.constraint)).max(axis=1)
    assert touched[0] > 0.1
    assert float(flown.drone.velocity[0, 0]) < 0.5


def test_what_acts_beside_the_model_is_said(write, drone):
    thick = WORLD.replace("<worldbody>", '<option density="1.2" timestep="0.0005"/><worldbody>')
    path = write(thick, "thick.xml")
    with pytest.warns(CfbWarning, match="MuJoCo's drag"):
        scene = Scene(path, "c")
    with pytest.warns(
        CfbWarning, match="asks for steps of 0.5 ms, and is stepped every 2 ms; give the drone substeps=4"
    ):
        scene.begin(drone, drone.hover_state((0.0, 5.0, 1.0)))


@mjx
def test_the_c_engine_says_that_it_has_no_derivatives(worlds, drone):
    scene = worlds[0]["c"]
    state = scene.begin(drone, drone.hover_state((0.0, 5.0, 1.0)))
    with pytest.raises(CfbError, match="no derivatives"):
        jax.grad(lambda u: scene.step(drone, state, u).drone.velocity[2])(drone.hover_command())


@mjx
def test_derivatives_through_contact_match_finite_differences(worlds, drone):
    scene = worlds[0]["mjx"]
    start = replace(drone.hover_state((0.41, 0.0, 1.0)), velocity=jnp.array([1.0, 0.0, 0.0]))
    state, u = scene.begin(drone, start), drone.hover_command()

    @jax.jit
    def speed(u):
        return scene.rollout(drone, state, jnp.tile(u, (10, 1))).drone.velocity[-1, 0]

    direction = jnp.array([0.1, -0.1, -0.1, 0.1])
    slope = jax.jvp(speed, (u,), (direction,))[1]
    h = 1e-5
    # The solver stops at a tolerance, which limits both.
    np.testing.assert_allclose(slope, (speed(u + h * direction) - speed(u - h * direction)) / (2 * h), rtol=0.03)


def test_worlds_that_cannot_be_are_refused(write):
    with pytest.raises(CfbError, match="cannot compile"):
        Scene(write(WORLD.replace('type="box"', 'type="cube"'), "cube.xml"))
    hinged = WORLD.replace("<worldbody>", '<worldbody><body name="cfb"><joint/><geom size="0.1"/></body>')
    with pytest.raises(CfbError, match="free joint"):
        Scene(write(hinged, "hinged.xml"))
