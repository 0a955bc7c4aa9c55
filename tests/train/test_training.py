"""Both algorithms, small: gradients against differences, learning, and going on after an interruption."""

import csv
from dataclasses import replace
from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from cfb_mjx.control.neural import NeuralController
from cfb_mjx.control.policy_file import load_policy
from cfb_mjx.envs import TargetTask
from cfb_mjx.errors import CfbError
from cfb_mjx.model import Quadrotor, rollout_final
from cfb_mjx.parameters import load_model_file, load_randomisation, save_model_file
from cfb_mjx.train import run
from cfb_mjx.train.analytic import Analytic
from cfb_mjx.train.brax_compat import brax_ppo, parts
from cfb_mjx.train.config import AnalyticSettings, PpoSettings, load_config
from cfb_mjx.train.flying import Hover, load_plants
from cfb_mjx.train.ppo import Ppo, beside_copies
from cfb_mjx.train.run import BEST, CHECKPOINT, CURVE, POLICY, UPDATES, Training, segments, train
from tests.helpers import SMALL_TRAINING, watch_keys

pytestmark = [pytest.mark.xdist_group("training"), pytest.mark.haste]

ALGORITHMS = ("analytic", "ppo")


def small(algorithm: str, *changes: str) -> Training:
    return Training.prepare(
        load_config("target", (*SMALL_TRAINING, f"algorithm={algorithm}", *changes)), {"cfb_mjx": "test"}
    )


def weights(folder) -> list[np.ndarray]:
    return jax.tree.leaves(load_policy(folder / POLICY).controller)


def test_the_gradient_of_a_flight_is_that_of_differences():
    task = TargetTask(randomisation=load_randomisation("paper"))
    analytic = Analytic(AnalyticSettings(drones=2, horizon_s=0.08), task, Quadrotor.from_file("cfb-guards"))
    controller = NeuralController.random(jax.random.PRNGKey(0), task.layout, (8, 8))
    # Weights of the size that training gives them: the first ones hardly look at what is seen.
    controller = jax.tree.map(lambda w: w + 0.3 * jax.random.normal(jax.random.PRNGKey(w.size), w.shape), controller)
    episodes = analytic.begin(jax.random.PRNGKey(1), controller).episodes

    @jax.jit
    def loss(controller):
        return analytic._loss(controller, episodes)[0]

    gradient = jax.jit(jax.grad(loss))(controller)
    rng = np.random.default_rng(0)
    for _ in range(3):
        way = jax.tree.map(lambda w: jnp.asarray(rng.normal(size=w.shape)), controller)
        along = sum(jnp.vdot(g, d) for g, d in zip(jax.tree.leaves(gradient), jax.tree.leaves(way), strict=True))
        ahead, behind = (jax.tree.map(lambda w, d, h=h: w + h * d, controller, way) for h in (1e-5, -1e-5))
        np.testing.assert_allclose(along, (loss(ahead) - loss(behind)) / 2e-5, rtol=1e-5)


class Idle(eqx.Module):
    """An algorithm that learns nothing, and a state of it."""

    episodes: None = None
    network: NeuralController | None = None
    updates: int = eqx.field(static=True, default=1)
    steps_per_update: int = eqx.field(static=True, default=1)

    def begin(self, key, controller):
        jax.random.split(key)
        return Idle(None, controller)

    def update(self, state):
        return state, {}

    def controller(self, state):
        return state.network


def test_no_key_of_a_training_is_used_twice(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "build", lambda *_: Idle())
    flown = Hover(*np.zeros((4, 1)), np.zeros(1, bool)), None
    monkeypatch.setattr(run, "hover", lambda controller, task, nominal, keys: flown)
    uses = watch_keys(monkeypatch)
    train(small("ppo"), tmp_path)
    assert uses.count > 5
    assert uses.of_no_key_twice()


class Diverging(Idle):
    """Weights are numbers until the last update."""

    updates: int = eqx.field(static=True, default=2)

    def update(self, state):
        last = state.network is not None and bool(state.network.network.biases[0][0] == 7)
        value = jnp.nan if last else 7.0
        return Idle(
            None, eqx.tree_at(lambda c: c.network.biases[0], state.network, replace_fn=lambda b: b * 0 + value)
        ), {}


def test_weights_that_are_no_numbers_end_a_training_and_cost_no_earlier_policy(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "build", lambda *_: Diverging())
    with pytest.raises(
        CfbError, match=r"by update 2 the policy's weights are not finite any more; the policy of update 1 is kept"
    ):
        train(small("ppo", "checkpoints=2"), tmp_path, evaluate=False)
    assert all(np.isfinite(w).all() for w in weights(tmp_path))
    assert len((tmp_path / CURVE).read_text().splitlines()) == 2


@pytest.mark.long
def test_both_bodies_give_the_same_gradient():
    config = load_config("target", ("analytic.drones=2", "analytic.horizon_s=0.016", "network.hidden=[8]", "body=mjx"))
    found = []
    for training in (Training.prepare(config, {}), Training.prepare(replace(config, body="rigid"), {})):
        nominal, task = training.nominal(), training.config.build_task()
        analytic = Analytic(config.analytic, task, nominal)
        controller = training.first_controller(nominal)
        episodes = analytic.begin(jax.random.PRNGKey(1), controller).episodes
        found.append(jax.jit(jax.grad(lambda c, a=analytic, e=episodes: a._loss(c, e)[0]))(controller))
    for mjx, rigid in zip(*map(jax.tree.leaves, found), strict=True):
        np.testing.assert_allclose(mjx, rigid, rtol=1e-6, atol=1e-9)


def test_a_failed_drone_pays_for_the_rest_of_the_horizon_and_harms_no_gradient():
    task = TargetTask()
    settings = AnalyticSettings(drones=2, horizon_s=0.08)
    analytic = Analytic(settings, task, Quadrotor.from_file("cfb-guards"))
    controller = NeuralController.random(jax.random.PRNGKey(0), task.layout, (8,))
    episodes = analytic.begin(jax.random.PRNGKey(1), controller).episodes
    thrown = jnp.array([[1e6, 0.0, 0.0], [0.0, 0.0, 0.0]])
    episodes = eqx.tree_at(lambda e: e.state.velocity, episodes, thrown)
    (_, (after, alive)), gradient = jax.value_and_grad(analytic._loss, has_aux=True)(controller, episodes)
    assert alive.tolist() == [False, True]
    np.testing.assert_array_equal(after.state.velocity[0], thrown[0])
    assert all(bool(jnp.all(jnp.isfinite(g))) for g in jax.tree.leaves(gradient))
    costs = jax.vmap(analytic._fly, in_axes=(None, 0))(controller, episodes)[0]
    np.testing.assert_allclose(costs[0], settings.cost.failure)


def test_updates_lower_what_the_same_flights_cost():
    config = load_config(
        "target",
        (
            *SMALL_TRAINING,
            "starts.near=0.5",
            "analytic.learning_rate=0.01",
            "analytic.horizon_s=0.2",
            "analytic.updates=400",
        ),
    )
    task = config.build_task()
    analytic = Analytic(config.analytic, task, Quadrotor.from_file("cfb-guards"))
    first = NeuralController.random(jax.random.PRNGKey(1), task.layout, (8, 8), hover=0.4)
    flights = analytic.begin(jax.random.PRNGKey(0), first)
    state, losses = flights, []
    for _ in range(40):
        state = eqx.tree_at(lambda s: s.episodes, state, flights.episodes)
        state, metrics = analytic.update(state)
        losses.append(float(metrics["loss"]))
    assert losses[-1] < 0.9 * losses[0]


def test_ppo_finds_the_command_that_is_rewarded():
    # Only the torque that a command asks for counts, and only the present: what is best is known, equal commands.
    only = [f"reward.{name}=0" for name in ("position", "near", "velocity", "attitude", "body_rate", "failure")]
    now = (
        "reward.torque=1",
        "ppo.discount=0",
        "ppo.reward_scaling=1",
        "ppo.first_std=0.1",
        "ppo.learning_rate=0.01",
        "ppo.smoothness=0",
    )
    sizes = ("ppo.drones=64", "ppo.unroll=4", "ppo.steps=10240", "randomisation.magnitude=0")
    config = load_config("target", (*SMALL_TRAINING, *only, *now, *sizes))
    task = config.build_task()
    ppo = Ppo(config.ppo, task, Quadrotor.from_file("cfb-guards"))
    first = NeuralController.random(jax.random.PRNGKey(1), task.layout, (8, 8))
    skewed = eqx.tree_at(lambda c: c.network.biases[-1], first, jnp.array([-0.4, 0.1, 0.6, 0.1]))
    state, rewards = ppo.begin(jax.random.PRNGKey(0), skewed), []
    for _ in range(ppo.updates):
        state, metrics = ppo.update(state)
        rewards.append(float(metrics["reward"]))
    assert np.mean(rewards[:3]) < 0.6
    assert np.mean(rewards[-3:]) > 0.75


def collected_after_throwing(faster, **changes):
    """Commands of eight drones, four copies each of two episodes; ``faster`` of them begin too fast."""
    settings = PpoSettings(drones=8, copies=4, minibatches=2, unroll=24, steps=1, value_hidden=(8,), least_reward=-7.0)
    task = TargetTask(randomisation=load_randomisation("paper"), **changes)
    ppo = Ppo(settings, task, Quadrotor.from_file("cfb-guards"))
    state = ppo.begin(jax.random.PRNGKey(0), NeuralController.random(jax.random.PRNGKey(1), task.layout, (8, 8)))
    episodes, lost = state.episodes
    episodes = eqx.tree_at(lambda e: e.count, episodes, jnp.zeros_like(episodes.count))
    episodes = eqx.tree_at(lambda e: e.state.velocity, episodes, episodes.state.velocity.at[faster].set(50.0))
    after, data, outcome = eqx.filter_jit(ppo._collect)(state.actor, (episodes, lost), jax.random.PRNGKey(2))
    return ppo, state, episodes, after, data, outcome


def test_the_learner_is_shown_no_reward_below_the_least_and_failed_drones_begin_anew():
    ppo, _, episodes, (after, lost), data, outcome = collected_after_throwing(slice(0, 4))
    np.testing.assert_array_equal(outcome.failed[0], [True] * 4 + [False] * 4)
    assert float(outcome.reward[0, :4].max()) < ppo.task.largest_reward - 300
    scaling = ppo.settings.reward_scaling
    np.testing.assert_array_equal(data["reward"][0, :4], -7 * scaling)
    np.testing.assert_array_equal(data["reward"][1:], outcome.reward[1:] * scaling)
    # Another drone each, and the rest of the commands flown with it.
    assert not np.any(np.asarray(after.model.parameters.mass)[:4] == np.asarray(episodes.model.parameters.mass)[:4])
    np.testing.assert_array_equal(after.count[:4], ppo.settings.unroll - 1)
    np.testing.assert_array_equal(data["flown"], 1.0)
    assert not np.any(lost)


def test_a_copy_that_fails_waits_for_the_others_and_nothing_is_learnt_from_it():
    *_, episodes, (after, lost), data, _ = collected_after_throwing(slice(1, 3))
    np.testing.assert_array_equal(lost, [False, True, True] + [False] * 5)
    flown = np.ones((24, 8))
    flown[1:, 1:3] = 0.0
    np.testing.assert_array_equal(data["flown"], flown)
    np.testing.assert_array_equal(data["failed"], 1.0 - np.concatenate([flown[1:], flown[-1:]]))
    # The others fly on, on the same drone; nobody is cut short.
    np.testing.assert_array_equal(after.count, [24, 0, 0, 24, 24, 24, 24, 24])
    np.testing.assert_array_equal(after.model.parameters.mass, episodes.model.parameters.mass)
    np.testing.assert_array_equal(data["cut"], 0.0)
    # With their time it is over for those who wait, too.
    *_, episodes, (after, lost), data, _ = collected_after_throwing(slice(1, 3), episode_s=0.08)
    assert not np.any(lost)
    np.testing.assert_array_equal(data["cut"][9], [1.0, 0.0, 0.0] + [1.0] * 5)
    np.testing.assert_array_equal(data["flown"].sum(axis=0), [24, 15, 15, 24, 24, 24, 24, 24])
    assert not np.any(np.asarray(after.model.parameters.mass)[:4] == np.asarray(episodes.model.parameters.mass)[:4])


def test_a_change_of_command_has_its_price_within_a_flight_alone():
    """Not from the end of one to the beginning of the next, nor of what a lost copy would have flown."""
    ppo, state, *_, data, _ = collected_after_throwing(slice(1, 3), episode_s=0.08)
    of_network = ppo.controller(state).network
    mean = np.tanh(np.asarray(of_network(data["seen"])))
    changes = []
    for copy in range(8):
        # Ten commands a flight; copies 1 and 2 are lost after the first of theirs, and begin again with the others.
        for begin, end in ((0, 1 if copy in (1, 2) else 10), (10, 20), (20, 24)):
            changes += [float(np.sum((b - a) ** 2)) for a, b in pairwise(mean[begin:end, copy])]
    last = data["hidden"][-1]
    weights = jnp.asarray(1.0), jnp.asarray(0.0)
    both, keys = (state.actor, state.critic), jax.random.split(jax.random.PRNGKey(0), 8)
    total, metrics = jax.jit(ppo._loss)(both, weights, data, last, keys)
    assert float(metrics["change"]) == pytest.approx(np.mean(changes), rel=1e-4)
    free = Ppo(replace(ppo.settings, smoothness=0.0), ppo.task, ppo.nominal)
    without, _ = jax.jit(free._loss)(both, weights, data, last, keys)
    assert float(total - without) == pytest.approx(ppo.settings.smoothness * np.mean(changes), rel=1e-3)


def test_what_a_value_errs_by_in_all_copies_tells_nothing_of_a_command():
    """Brax's advantages with values wrong by anything that copies share are, beside the copies, those of the right."""
    of_reward, of_value, of_error = jax.random.split(jax.random.key(0), 3)
    rewards, values = jax.random.normal(of_reward, (32, 12)), jax.random.normal(of_value, (33, 12))
    error = jnp.repeat(3 * jax.random.normal(of_error, (33, 3)), 4, axis=1)
    cut = jnp.zeros((32, 12)).at[10, 4:8].set(1.0)

    def advantages(values):
        _, found = parts().losses.compute_gae(
            truncation=cut,
            termination=jnp.zeros_like(cut),
            rewards=rewards,
            values=values[:-1],
            bootstrap_value=values[-1],
            lambda_=0.97,
            discount=0.99,
        )
        return found

    right, wrong = advantages(values), advantages(values + error)
    assert float(jnp.std(wrong - right)) > float(jnp.std(right))
    all_of_them = jnp.ones((32, 12))
    found = beside_copies(right, all_of_them, 4)
    np.testing.assert_allclose(beside_copies(wrong, all_of_them, 4), found, atol=1e-4)
    np.testing.assert_allclose(found.reshape(32, 3, 4).mean(axis=-1), 0.0, atol=1e-5)
    np.testing.assert_array_equal(beside_copies(right, all_of_them, 1), right)
    # Of a copy that is lost nothing is known, and nothing is counted.
    flown = all_of_them.at[5:, 1].set(0.0)
    there = np.delete(np.asarray(right).reshape(32, 3, 4)[5:, 0], 1, axis=-1)
    found = np.delete(np.asarray(beside_copies(right, flown, 4))[5:, :4], 1, axis=-1)
    np.testing.assert_allclose(found, there - there.mean(axis=-1, keepdims=True), atol=1e-5)


def test_copies_fly_the_same_episode_with_other_commands():
    """Drone, target and noise alike, and the same command of it, whichever of them fails or runs out of time."""
    settings = PpoSettings(drones=24, copies=3, minibatches=2, unroll=64, steps=1, value_hidden=(8,))
    task = TargetTask(randomisation=load_randomisation("paper"), episode_s=0.8)
    ppo = Ppo(settings, task, Quadrotor.from_file("cfb-guards"))
    state = ppo.begin(jax.random.PRNGKey(1), NeuralController.random(jax.random.PRNGKey(0), task.layout, (8, 8)))
    before = np.asarray(state.episodes[0].count)
    state, _ = ppo.update(state)
    episodes, lost = state.episodes

    def in_groups(x):
        return np.asarray(x).reshape(8, 3, -1)

    for same in (episodes.model.parameters.mass, episodes.target):
        np.testing.assert_array_equal(in_groups(same), in_groups(same)[:, :1].repeat(3, axis=1))
    count = np.where(lost, -1, episodes.count)
    flown = in_groups(count).max(axis=1)
    assert np.all((in_groups(count)[..., 0] == flown) | in_groups(lost)[..., 0])
    # Episodes have ended, and began at different times.
    assert np.any(np.asarray(episodes.count) < before + 64)
    assert len(set(flown[:, 0])) > 3
    position = in_groups(episodes.state.position)
    assert np.all((np.ptp(position, axis=1).max(axis=-1) > 0) | (flown[:, 0] == 0))
    assert np.ptp(in_groups(episodes.model.parameters.mass)[:, 0]) > 1e-3


# In the middle of a segment, and after its last update.
@pytest.mark.parametrize(("algorithm", "at"), [("analytic", 3), ("ppo", 3), ("ppo", 4)])
def test_an_interrupted_training_goes_on_from_its_last_update_to_the_same_end(tmp_path, algorithm, at):
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    rows = train(small(algorithm), whole, evaluate=False)

    def interrupt(done, total, rate, left):
        assert total == 4
        if done == at:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(small(algorithm), cut, evaluate=False, progress=interrupt)
    assert len((cut / CURVE).read_text().splitlines()) == 2
    assert run.read_about(cut / CHECKPOINT)["updates"] == at
    flown = []
    resumed = train(small(algorithm), cut, True, evaluate=False, log=lambda commands, metrics: flown.append(commands))
    assert len(flown) == 4 - at
    assert (whole / POLICY).read_bytes() == (cut / POLICY).read_bytes()
    assert (whole / UPDATES).read_text() == (cut / UPDATES).read_text()
    for a, b in zip(rows, resumed, strict=True):
        assert {k: v for k, v in a.items() if k != "seconds"} == {k: v for k, v in b.items() if k != "seconds"}


def test_every_update_says_what_tells_how_learning_goes(tmp_path):
    logged = []
    train(small("ppo"), tmp_path, evaluate=False, log=lambda commands, metrics: logged.append(metrics))
    assert {"reward", "failing", "std", "value_loss", "value_explained", "entropy", "kl", "clipped"} < set(logged[0])
    assert all(np.isfinite(list(metrics.values())).all() for metrics in logged)
    assert all(metrics["value_explained"] <= 1 and metrics["kl"] >= -1e-6 for metrics in logged)
    assert all(0 <= metrics["clipped"] <= 1 for metrics in logged)
    with open(tmp_path / UPDATES) as file:
        rows = list(csv.DictReader(file))
    assert [int(row["update"]) for row in rows] == [1, 2, 3, 4]
    np.testing.assert_allclose([float(row["kl"]) for row in rows], [m["kl"] for m in logged], rtol=1e-4)


def test_the_best_policy_is_the_one_that_randomised_drones_fly_best_with():
    def best(*random_mm):
        return run._is_best([{"hover_mm": 5.0 - i, "random_mm": mm} for i, mm in enumerate(random_mm)])

    assert best(3.0)
    assert best(3.0, 2.0)
    assert not best(2.0, 3.0)
    assert not best(2.0, 3.0, 2.5)
    # Where most drones are lost.
    assert not best(3.0, np.inf)
    assert run._is_best([{"hover_mm": 3.0}, {"hover_mm": 2.0}])


def test_the_policy_a_training_starts_from_is_left_alone_until_its_worth_is_known(tmp_path):
    config = load_config("target", (*SMALL_TRAINING, "ppo.warm_up=2", "ppo.warm_std=0.03"))
    task, nominal = config.build_task(), Quadrotor.from_file("cfb-guards")
    first = NeuralController.random(jax.random.PRNGKey(1), task.layout, (8, 8))
    for trained in (True, False):
        ppo = Ppo(config.ppo, task, nominal, trained=trained)
        states = [ppo.begin(jax.random.PRNGKey(0), first)]
        np.testing.assert_allclose(jax.nn.softplus(states[0].actor.raw_std), 0.03 if trained else 0.2, rtol=1e-5)
        for _ in range(3):
            states.append(ppo.update(states[-1])[0])
        same = [all(map(np.array_equal, *map(jax.tree.leaves, (s.actor, states[0].actor)))) for s in states[1:]]
        assert same == ([True, True, False] if trained else [False] * 3)
        valued = [all(map(np.array_equal, *map(jax.tree.leaves, (s.critic, states[0].critic)))) for s in states[1:]]
        assert valued == [False] * 3


def test_the_policy_goes_no_further_in_an_update_than_it_may():
    sizes = ("ppo.drones=64", "ppo.epochs=4", "ppo.learning_rate=0.03", "ppo.steps=100000", "ppo.warm_up=3")
    task = load_config("target", SMALL_TRAINING).build_task()
    first = NeuralController.random(jax.random.PRNGKey(1), task.layout, (8, 8))
    # As one that holds a drone to the centimetre: what it does changes a lot with its weights.
    first = jax.tree.map(lambda w: 3 * w, first)
    furthest = {}
    for most in (0.0, 0.01):
        config = load_config("target", (*SMALL_TRAINING, *sizes, f"ppo.largest_kl={most}"))
        ppo = Ppo(config.ppo, task, Quadrotor.from_file("cfb-guards"), trained=True)
        state, kl = ppo.begin(jax.random.PRNGKey(0), first), []
        for _ in range(10):
            state, metrics = ppo.update(state)
            kl.append(float(metrics["kl"]))
        furthest[most] = max(kl)
    assert furthest[0.0] > 0.5
    # Mean over an update, none of whose steps begins beyond twice as much.
    assert 0.001 < furthest[0.01] < 0.02


@pytest.mark.long
@pytest.mark.parametrize("name", ["target", "target-analytic", "target-adaptive", "flip", "flip-analytic"])
def test_ppo_keeps_what_the_shipped_policy_can_do(name):
    with jax.enable_x64(False):
        training = Training.prepare(load_config(name, ("algorithm=ppo",)), {}, name)
        nominal, task = training.nominal(), training.config.build_task()
        ppo = run.build(training.config, task, nominal, None, True)
        state = ppo.begin(jax.random.PRNGKey(0), training.first_controller(nominal))
        before = run._judged(ppo.controller(state), training, task, nominal)
        least, shares = ("hover_mm", "random_mm"), ("hover_failed", "random_failed")
        if training.config.task == "flip":
            least, shares = ("rate_error_radps", "axis_error"), ("failed",)
        # Finer than that, PPO's reward, a bell of a quarter of a metre, does not tell policies apart.
        told_apart = {"hover_mm": 20.0, "random_mm": 30.0} if name == "target-adaptive" else {}
        for update in range(20):
            state, _ = ppo.update(state)
            after = run._judged(ppo.controller(state), training, task, nominal)
            for key in least:
                most = 1.2 if update < 10 or key == "random_mm" else 1.5
                kept = after[key] < most * before[key] or (update >= 10 and after[key] < told_apart.get(key, 0.0))
                assert kept, (update, key)
            assert all(after[key] == 0 for key in shares)
    # That it is let go at all.
    assert after[least[0]] != before[least[0]]


def test_a_training_stopped_between_its_files_is_as_it_was_before_them(tmp_path, monkeypatch):
    before, table = {}, run._csv

    def stop_at_the_second(rows):
        if len(rows) == 4:
            before.update((path.name, path.read_bytes()) for path in tmp_path.iterdir() if path.name[0] != ".")
            raise KeyboardInterrupt
        return table(rows)

    monkeypatch.setattr(run, "_csv", stop_at_the_second)
    with pytest.raises(KeyboardInterrupt):
        train(small("analytic"), tmp_path, evaluate=False)
    assert {POLICY, BEST, CURVE, UPDATES, CHECKPOINT} <= set(before)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
    assert run.read_about(tmp_path / CHECKPOINT)["updates"] == 2


def test_a_training_goes_on_after_its_folder_and_its_models_have_moved(tmp_path):
    old, new = tmp_path / "old", tmp_path / "new"
    old.mkdir()
    described = load_model_file("cfb-guards").with_values("a test", mass=0.045)
    save_model_file(described, old / "model.yaml")
    train(small("ppo", f"model={old / 'model.yaml'}"), old / "run", evaluate=False)
    old.rename(new)
    train(small("ppo", f"model={new / 'model.yaml'}"), new / "run", resume=True, evaluate=False)
    # What the model says still counts.
    save_model_file(described.with_values("a test", mass=0.046), new / "model.yaml")
    with pytest.raises(CfbError, match=r"another model\.parameters\.mass"):
        train(small("ppo", f"model={new / 'model.yaml'}"), new / "run", resume=True, evaluate=False)


def test_earlier_trainings_are_not_overwritten_nor_mixed(tmp_path):
    train(small("ppo"), tmp_path, evaluate=False)
    before = (tmp_path / POLICY).read_bytes()
    # Nothing is left to do, and nothing changes; a training is the same whatever it is called.
    train(small("ppo", "description=as it was"), tmp_path, resume=True, evaluate=False)
    assert (tmp_path / POLICY).read_bytes() == before
    with pytest.raises(CfbError, match="holds a training already"):
        train(small("ppo"), tmp_path, evaluate=False)
    with pytest.raises(CfbError, match=r"another config\.ppo\.learning_rate"):
        train(small("ppo", "ppo.learning_rate=0.1"), tmp_path, resume=True, evaluate=False)
    (tmp_path / CHECKPOINT).write_bytes((tmp_path / CHECKPOINT).read_bytes()[:300])
    with pytest.raises(CfbError, match=r"checkpoint\.npz"):
        train(small("ppo"), tmp_path, resume=True, evaluate=False)
    assert (tmp_path / POLICY).read_bytes() == before


def test_one_algorithm_goes_on_from_the_others_policy(tmp_path):
    train(small("analytic"), tmp_path / "first", evaluate=False)
    config = load_config("target", (*SMALL_TRAINING, "algorithm=ppo", "ppo.learning_rate=1e-12"))
    training = Training.prepare(config, {}, tmp_path / "first" / POLICY)
    train(training, tmp_path / "second", evaluate=False)
    for a, b in zip(weights(tmp_path / "first"), weights(tmp_path / "second"), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)
    other = load_config("target", (*SMALL_TRAINING, "network.hidden=[9]"))
    with pytest.raises(CfbError, match="observation or network differs from the configuration"):
        Training.prepare(other, {}, tmp_path / "first" / POLICY)


def test_a_policy_carries_a_card_of_its_training(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "_judged", lambda *given: {"hover_mm": 12.345, "hover_failed": 0.25})
    training = small("analytic", "noise.pose_jitter_s=0.003", "seed=7")
    train(training, tmp_path / "first")
    card = load_policy(tmp_path / "first" / POLICY).card
    flown = int(list(csv.DictReader((tmp_path / "first" / CURVE).read_text().splitlines()))[-1]["commands"])
    words = "Back-propagation", "seed 7", f"{flown / 1e6:.3g} M commands", "`cfb-guards`", "plus up to 3 ms"
    for word in (*words, "- hover_mm: 12.3\n", "- hover_failed: 0.25\n"):
        assert word in card
    assert load_policy(tmp_path / "first" / BEST).card != card, "that of its own checkpoint"
    further = Training.prepare(load_config("target", SMALL_TRAINING), {}, tmp_path / "first" / POLICY)
    policy = further.policy(further.start.controller, 1000, {})
    assert f"continues the policy with the weights {further.start.weights_sha256[:12]}" in policy.card
    assert policy.card.endswith("Not evaluated.\n")


def test_a_model_with_effects_is_trained_on_and_a_predictor_is_refused(tmp_path):
    effects = (
        {"name": "rotor_drag", "parameters": {"coefficient": 1e-6}},
        {"name": "payload_swing", "parameters": {"mass": 0.004, "length": 0.2}},
    )
    base = load_model_file("cfb-guards")
    save_model_file(replace(base, effects=effects), tmp_path / "m.yaml")
    config = replace(load_config("target", SMALL_TRAINING), model=str(tmp_path / "m.yaml"))
    train(Training.prepare(config, {}), tmp_path / "run", evaluate=False)
    save_model_file(replace(base, kind="predictor"), tmp_path / "p.yaml")
    config = replace(config, model=str(tmp_path / "p.yaml"))
    with pytest.raises(CfbError, match=r"predictor, not a plant.*--force"):
        Training.prepare(config, {})
    assert Training.prepare(config, {}, force=True).described.kind == "predictor"


def test_checkpoints_are_spread_evenly_and_end_with_the_training():
    assert segments(10, 4) == [2, 5, 8, 10]
    assert segments(3, 10) == [1, 2, 3]


def test_braxs_own_ppo_runs_here_and_leaves_jax_as_it_was():
    had = hasattr(jax, "device_put_replicated")
    with brax_ppo() as brax_train:
        assert callable(brax_train)
        spread = jax.device_put_replicated({"a": jnp.arange(3.0)}, jax.local_devices()[:1])
        np.testing.assert_array_equal(spread["a"], [[0.0, 1.0, 2.0]])
        from brax import envs

        sizes = {"num_envs": 4, "batch_size": 4, "num_minibatches": 1, "unroll_length": 4, "num_updates_per_batch": 1}
        _, params, _ = brax_train(
            envs.get_environment("fast"), num_timesteps=32, episode_length=8, run_evals=False, **sizes
        )
        assert all(bool(jnp.all(jnp.isfinite(x))) for x in jax.tree.leaves(params[1]))
    assert hasattr(jax, "device_put_replicated") == had


@pytest.mark.parametrize("name", ["target", "target-analytic", "target-adaptive"])
def test_shipped_trainings_can_be_begun(name):
    training = Training.prepare(load_config(name), {})
    nominal = training.nominal()
    assert training.config.build_task().hold(nominal) == 2
    assert training.first_controller(nominal).layout == training.config.observation


def test_off_nominal_plants_differ_from_the_nominal_one_and_hover(tmp_path):
    base = load_model_file("cfb-guards")
    plants = load_plants(base)
    assert len(plants) >= 8
    start = Quadrotor.from_file(base).hover_state()
    # A change on the way: a late or slow drone hovers like any other.
    commands = jnp.full((50, 4), 0.55).at[10:].add(jnp.array([0.0, 0.02, 0.0, 0.0]))
    plain = rollout_final(Quadrotor.from_file(base), start, commands)
    for name, drone in plants.items():
        moved = rollout_final(drone, start, commands)
        assert bool(jnp.all(jnp.isfinite(moved.position))), name
        turned = np.abs(moved.quaternion - plain.quaternion).max()
        assert max(turned, np.abs(moved.position - plain.position).max()) > 1e-5, name
    (tmp_path / "p.yaml").write_text("format: cfb_mjx plants 1\nplants: [{effects: []}]")
    with pytest.raises(CfbError, match=r"p\.yaml: every plant needs a name"):
        load_plants(base, tmp_path / "p.yaml")
    with pytest.raises(CfbError, match="no such set of plants"):
        load_plants(base, "nothing")


def test_the_loss_is_the_articles_written_out():
    """Schulman et al. 2016 and 2017 in NumPy: advantages, their limit, the clipped ratio, the value's error."""
    ppo, state, *_, data, _ = collected_after_throwing(slice(1, 2), episode_s=0.08)
    ppo = Ppo(replace(ppo.settings, smoothness=0.0, advantage_limit=1.5), ppo.task, ppo.nominal)
    # A policy that has moved on since the flights, so that some ratios are clipped.
    actor = eqx.tree_at(
        lambda a: a.network.biases[-1], state.actor, replace_fn=lambda b: b + jnp.array([0.1, -0.1, 0.05, 0.0])
    )
    actor = eqx.tree_at(lambda a: a.raw_std, actor, replace_fn=lambda s: s + 0.2)
    last = data["hidden"][-1]
    loss = jax.jit(ppo._loss)
    both, keys = (actor, state.critic), jax.random.split(jax.random.PRNGKey(0), 8)
    total, metrics = loss(both, (jnp.asarray(1.0), jnp.asarray(0.0)), data, last, keys)
    dearer, _ = loss(both, (jnp.asarray(1.0), jnp.asarray(0.5)), data, last, keys)

    s, n = ppo.settings, {k: np.asarray(v, float) for k, v in data.items() if k not in ("seen", "hidden")}
    # The best reward forever, and what the network says of it.
    ideal = s.reward_scaling * ppo.task.largest_reward / (1 - s.discount)
    values, after = (ideal + np.asarray(state.critic(x))[..., 0] for x in (data["hidden"], last))
    advantage, returns, ahead, beyond = np.zeros_like(values), np.zeros_like(values), 0.0, after
    for i in reversed(range(len(values))):
        goes_on, whole = s.discount * (1 - n["failed"][i]), 1 - n["cut"][i]
        told = n["reward"][i] + goes_on * (after if i == len(values) - 1 else values[i + 1]) - values[i]
        ahead = whole * told + goes_on * whole * s.gae_lambda * ahead
        advantage[i] = whole * (n["reward"][i] + goes_on * beyond - values[i])
        returns[i] = beyond = values[i] + ahead
    flown = n["flown"]

    def mean(x):
        return np.sum(flown * x) / np.sum(flown)

    groups, there = advantage.reshape(24, 2, 4), flown.reshape(24, 2, 4)
    advantage = (groups - (groups * there).sum(-1, keepdims=True) / there.sum(-1, keepdims=True)).reshape(24, 8)
    most = 1.5 * mean(np.abs(advantage))
    assert np.any(np.abs(advantage) > most)
    advantage = np.clip(advantage, -most, most)
    advantage = advantage - mean(advantage)
    advantage /= np.sqrt(mean(advantage**2))
    loc, std = np.asarray(actor.network(data["seen"])), np.log1p(np.exp(np.asarray(actor.raw_std))) + 0.001
    raw = n["raw"]
    density = norm.logpdf(raw, loc, std).sum(-1)
    ratio = np.exp(density - n["log_prob"])
    assert 0.05 < mean(np.abs(ratio - 1) > s.clipping) < 0.95
    gain = mean(np.minimum(ratio * advantage, np.clip(ratio, 1 - s.clipping, 1 + s.clipping) * advantage))
    value_loss = mean((returns - values) ** 2) / 4
    assert float(metrics["value_loss"] - total) == pytest.approx(gain, abs=1e-6)
    assert float(metrics["value_loss"]) == pytest.approx(value_loss, rel=1e-5)
    assert float(metrics["kl"]) == pytest.approx(mean(ratio - 1 - np.log(ratio)), rel=1e-5)
    # More entropy is a gain.
    assert float(total - dearer) == pytest.approx(0.5 * float(metrics["entropy"]), rel=1e-4)
    # Brax's entropy, also of random commands.
    logits = jnp.concatenate([jnp.asarray(loc), jnp.broadcast_to(actor.raw_std, loc.shape)], axis=-1)
    draws = jax.vmap(lambda key: ppo.distribution.entropy(logits, key))(jax.random.split(jax.random.key(1), 200))
    each = (np.asarray(draws) * flown).sum((1, 2)) / flown.sum()
    assert abs(float(metrics["entropy"]) - each.mean()) < 4 * each.std()


def test_the_entropy_bonus_falls_to_its_last_share(monkeypatch):
    """From 0.003 to a fiftieth of that in equal steps; in an update's epochs it is constant."""
    ppo, state, _, after, data, outcome = collected_after_throwing(slice(0, 0))
    seen = []

    def learn(learnt, weights, data, last, key):
        seen.append([float(w) for w in weights])
        return learnt, {"kl": jnp.zeros(())}

    monkeypatch.setattr(ppo, "_collect", lambda *_: (after, data, outcome))
    monkeypatch.setattr(ppo, "_learn", learn)
    monkeypatch.setattr(ppo, "updates", 10)
    for count in (0, 5, 10):
        ppo._update(eqx.tree_at(lambda s: s.count, state, jnp.asarray(count)))
    np.testing.assert_allclose(seen, [[1.0, 3e-3], [1.0, 3e-3 * 0.51], [1.0, 3e-3 * 0.02]], rtol=1e-6)
