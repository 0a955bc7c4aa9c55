"""Training configurations: the shipped one is the defaults, and what is wrong is refused by the name of its key."""

import pytest

from cfb_mjx.envs import PAPER_REWARD
from cfb_mjx.errors import CfbError
from cfb_mjx.train.config import TrainingConfig, config_from, load_config
from cfb_mjx.train.strict import build


def test_the_shipped_configuration_is_the_defaults():
    shipped = load_config("target").to_mapping()
    assert {**shipped, "description": ""} == TrainingConfig().to_mapping()


def test_a_configuration_survives_being_written():
    config = load_config("target", ("seed=3", "network.hidden=[8, 8]", "ppo.learning_rate=1e-4"))
    assert config.seed == 3
    assert config.network.hidden == (8, 8)
    assert config.ppo.learning_rate == 1e-4
    assert build(TrainingConfig, config.to_mapping(), "again") == config


def test_a_configuration_from_before_there_was_a_bend_shows_positions_as_they_are():
    written = load_config("target").to_mapping()
    assert load_config("target").observation.position_bend_m == 0.1
    del written["observation"]["position_bend_m"]
    assert config_from(written, "an old file").observation.position_bend_m == 0.0
    assert (
        config_from({"task": "target", "observation": {"past_estimates": 2}}, "a new one").observation.position_bend_m
        == 0.1
    )


def test_a_reward_from_before_there_was_near_is_the_papers():
    written = load_config("target").to_mapping()
    assert load_config("target").reward.near == 3.0
    del written["reward"]["near"]
    assert config_from(written, "an old file").reward.near == 0.0
    assert config_from({"task": "target", "reward": {"torque": 0.1}}, "a new one").reward.near == 3.0


def test_a_change_of_a_file_is_asked_for_what_came_later_too(tmp_path):
    (tmp_path / "mine.yaml").write_text("format: cfb_mjx training 1\nreward: {torque: 0.2}")
    with pytest.raises(CfbError, match=r"mine\.yaml with reward\.position=5: reward gives position, but neither near"):
        load_config(tmp_path / "mine.yaml", ("reward.position=5",))
    assert load_config(tmp_path / "mine.yaml", ("reward.position=5", "reward.near=1")).reward.near == 1.0


def test_the_papers_reward_is_the_same_in_its_configuration_and_in_python():
    assert load_config("target-paper").reward == PAPER_REWARD


def test_a_count_may_be_written_with_an_exponent():
    """As the help of ``cfb train`` writes it."""
    steps = load_config("target", ("ppo.steps=2e7",)).ppo.steps
    assert (steps, type(steps)) == (20_000_000, int)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("task: target", "'format' must be"),
        ("format: cfb_mjx training 1\nrewards: {}", "unknown key 'rewards'"),
        ("format: cfb_mjx training 1\nreward: {positon: 1}", "unknown key 'reward.positon'"),
        ("format: cfb_mjx training 1\nppo: {drones: 2.5}", "ppo.drones must be a whole number"),
        ("format: cfb_mjx training 1\nppo: {drones: true}", "ppo.drones must be a whole number"),
        ("format: cfb_mjx training 1\nppo: {discount: .nan}", "ppo.discount must be a finite number"),
        ("format: cfb_mjx training 1\nppo: {discount: 1.5}", "ppo.discount = 1.5 must lie between 0 and 1"),
        ("format: cfb_mjx training 1\nppo: [1]", "ppo must be a mapping"),
        ("format: cfb_mjx training 1\nalgorithm: sac", "algorithm must be one of ppo, analytic"),
        ("format: cfb_mjx training 1\nnetwork: {hidden: []}", "network.hidden must contain at least one layer"),
        ("format: cfb_mjx training 1\nnetwork: {hidden: 32}", "network.hidden must be a list"),
        ("format: cfb_mjx training 1\nepisode_s: 0", "episode_s = 0.0 must be positive"),
        ("format: cfb_mjx training 1\nobservation: {past_commands: -1}", "observation.past_commands = -1"),
        ("format: cfb_mjx training 1\nppo: {drones: 10, minibatches: 4}", "ppo.drones = 10"),
        (
            "format: cfb_mjx training 1\nreward: {position: 5}",
            "reward gives position, but neither near: 3.0 (the default) nor near: 0.0",
        ),
        (
            "format: cfb_mjx training 1\nobservation: {position_scale_m: 1}",
            "position_scale_m, but neither position_bend_m: 0.1",
        ),
        ("format: cfb_mjx training 1\nreward: {near_width_m: 0}", "reward.near_width_m = 0.0 must be positive"),
        ("format: cfb_mjx training 1\nrandomisation: {ranges: nothing}", "nothing: no such randomisation"),
    ],
)
def test_mistakes_are_refused_by_key(tmp_path, text, said):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(CfbError) as refusal:
        load_config(path)
    assert said in str(refusal.value)


@pytest.mark.parametrize("change", ["seed", "=3", "seed.x=3", "ppo.drones=[", "ppo=3", "nothing.at.all=1"])
def test_changes_that_mean_nothing_are_refused(change):
    with pytest.raises(CfbError, match=change.split("=")[0].split(".")[0] or "KEY=VALUE"):
        load_config("target", (change,))


def test_a_name_that_is_no_training_is_refused():
    with pytest.raises(CfbError, match="no such training"):
        load_config("hover")


def test_a_configuration_from_before_there_were_bends_shows_linear_scales_and_world_axes():
    written = load_config("target").to_mapping()
    for key in ("position_bend_m", "velocity_bend_mps", "body_position", "body_velocity"):
        del written["observation"][key]
    shown = config_from(written, "an old file").observation
    assert (shown.position_bend_m, shown.velocity_bend_mps) == (0.0, 0.0)
    assert (shown.body_position, shown.body_velocity) == (False, False)
