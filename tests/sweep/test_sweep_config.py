"""What a sweep's file may say, which tasks follow from it, and the sentence for everything else."""

import re
from datetime import date
from pathlib import Path

import pytest
import yaml

from cfb_mjx.cli import main
from cfb_mjx.commands import load
from cfb_mjx.commands.line import parse
from cfb_mjx.documents import shipped_names
from cfb_mjx.errors import CfbError
from cfb_mjx.sweep import load_sweep, tasks_of
from cfb_mjx.sweep.config import CHOSEN_HERE, EXTRA_FILES, KINDS, Parameters
from cfb_mjx.sweep.tasks import LONGEST, name_of

FLY = {"command": "fly", "arguments": {"controller": "pid"}, "over": {"seed": [0, 1]}}


@pytest.fixture
def tasks(tmp_path, monkeypatch):
    """Tasks of a sweep with these keys, in a folder with the logs of two drones."""
    for name in ("drones/a/1.mcap", "drones/a/2.csv", "drones/a/notes.txt", "drones/b/1.mcap", "empty/x.txt", "m.yaml"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("")
    monkeypatch.chdir(tmp_path)

    def of(**keys):
        document = {"format": "cfb_mjx sweep 1"} | keys
        Path("sweep.yaml").write_text(yaml.safe_dump(document, sort_keys=False))
        return tasks_of(load_sweep("sweep.yaml", load))

    return of


def lines(found) -> dict[str, str]:
    return {task.name: task.line for task in found}


def test_a_grid_is_every_combination_in_order(tasks):
    found = tasks(
        command="train",
        arguments={"task": "target", "config": "quick-analytic"},
        over={"set.randomisation.magnitude": [0, 0.5], "seed": [3, 4]},
    )
    start = "cfb train target --config quick-analytic --seed"
    assert lines(found) == {
        "magnitude=0_seed=3": f"{start} 3 --set randomisation.magnitude=0 --output .",
        "magnitude=0_seed=4": f"{start} 4 --set randomisation.magnitude=0 --output .",
        "magnitude=0.5_seed=3": f"{start} 3 --set randomisation.magnitude=0.5 --output .",
        "magnitude=0.5_seed=4": f"{start} 4 --set randomisation.magnitude=0.5 --output .",
    }
    assert found[3].varied == {"set.randomisation.magnitude": 0.5, "seed": 4}
    assert found[0].words(Path("/x"))[-2:] == ["--output", "/x"]


def test_one_task_for_every_folder_of_logs(tasks):
    found = tasks(command="fit", each={"logs": "drones/*/"}, arguments={"robust": True, "figure": "fit.png"})
    more = "--robust --output model.yaml --json result.json --figure fit.png"
    assert lines(found) == {
        "a": f"cfb fit drones/a/1.mcap drones/a/2.csv {more}",
        "b": f"cfb fit drones/b/1.mcap {more}",
    }


def test_what_varies_may_stand_in_braces(tasks):
    found = tasks(
        command="evaluate",
        arguments={"logs": "drones/{drone}/*.mcap"},
        each=[{"drone": "a", "set.mass": 0.041}, {"drone": "b", "set": {"mass": 0.043}, "name": "the other"}],
        over={"model": ["cfb", None]},
    )
    assert lines(found) == {
        "drone=a_mass=0.041_model=cfb": "cfb evaluate drones/a/1.mcap --model cfb --set mass=0.041 --json result.json",
        "drone=a_mass=0.041_model=default": "cfb evaluate drones/a/1.mcap --set mass=0.041 --json result.json",
        "the-other_model=cfb": "cfb evaluate drones/b/1.mcap --model cfb --set mass=0.043 --json result.json",
        "the-other_model=default": "cfb evaluate drones/b/1.mcap --set mass=0.043 --json result.json",
    }


def test_the_order_of_the_arguments_in_the_file_does_not_matter(tasks):
    one = tasks(command="fly", arguments={"controller": "pid", "plants": 3, "noise": False}, over={"seed": [1]})
    other = tasks(command="fly", arguments={"noise": False, "plants": 3, "controller": "pid"}, over={"seed": [1]})
    assert lines(one) == lines(other) == {"seed=1": "cfb fly pid --plants 3 --no-noise --seed 1 --json result.json"}


def test_lists_are_written_as_the_command_reads_them(tasks):
    train = tasks(command="train", arguments={"task": "target"}, over={"set.network.hidden": [[8, 8]]})
    assert train[0].arguments[-2:] == ("--set", "network.hidden=[8, 8]")
    fit = tasks(command="fit", arguments={"logs": "drones/b"}, over={"set.motor_gain": [[2900, 2900.5]]})
    assert fit[0].arguments[-1] == "motor_gain=2900,2900.5"
    held = tasks(command="fit", arguments={"logs": "drones/b", "held-out": "drones/a"}, over={"robust": [True, False]})
    assert lines(held)["robust=false"].startswith("cfb fit drones/b/1.mcap --held-out drones/a/1.mcap drones/a/2.csv -")


@pytest.mark.parametrize(
    ("varied", "name"),
    [
        ({"seed": 0}, "seed=0"),
        ({"set.reward.position": 1e-5, "set.starts.position": 2}, "set.reward.position=1e-05_set.starts.position=2"),
        ({"model": "models/heavy one.yaml"}, "model=heavy-one"),
        ({"noise": False, "model": None}, "noise=false_model=default"),
        ({"held_out": ["a/1.mcap", "a/2.mcap"]}, "held_out=1+2"),
        ({"on": "../../etc"}, "on=etc"),
    ],
)
def test_names_are_readable_and_safe(varied, name):
    assert name_of(None, varied) == name


def test_names_stay_short_and_apart_and_never_hide():
    long, other = (name_of(None, {"model": "x" * 300 + end}) for end in "ab")
    assert len(long) <= LONGEST
    assert long != other
    assert name_of("../.hidden", {}) == "hidden"
    assert name_of("...", {}) == "task"


@pytest.mark.parametrize("name", shipped_names("sweeps"))
def test_shipped_sweeps_are_sound(name, tasks):
    tasks(**FLY)  # the folder with drones
    found = tasks_of(load_sweep(name, load))
    assert len(found) > 1
    for task in found:
        assert parse(task.command, task.words(Path("."))[1:]).words()


def test_the_files_on_the_page_are_sound(tasks):
    tasks(**FLY)
    page = (Path(__file__).resolve().parents[2] / "docs" / "sweeps.md").read_text()
    blocks = re.findall(r"^```yaml\n(.*?)^```", page, flags=re.S | re.M)
    assert [len(tasks(**yaml.safe_load(block))) for block in blocks] == [12, 4, 2]


@pytest.mark.parametrize("command", KINDS)
def test_what_is_said_of_a_command_is_true_of_it(command):
    kind = KINDS[command]
    parameters = Parameters.of(command, load(command), kind)
    assert kind.positional is None or kind.positional in parameters.shapes
    assert ("output" in parameters.shapes) == (kind.output is not None)
    assert "json" in parameters.shapes or kind.writes_result
    assert all(f"--{name}" in kind.more for name in CHOSEN_HERE & set(parameters.shapes) - {"output", "json"})
    outputs = {name for name in parameters.shapes if name in EXTRA_FILES}
    assert all(parameters.shapes[name] == "file" for name in outputs)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"format": "cfb_mjx training 1"}, "'format' must be 'cfb_mjx sweep 1'"),
        ({"ovr": {}}, "unknown key 'ovr'"),
        ({"command": "view"}, "'command' must be one of"),
        ({"command": None}, "'command' must be one of"),
        ({"arguments": [1]}, "'arguments' must be a mapping"),
        ({"arguments": {"controller": "pid", "speed": 3}}, "arguments.speed is not an argument of cfb fly"),
        ({"arguments": {"controller": "pid", "json": "x.json"}}, "arguments.json: the sweep sets this itself"),
        ({"arguments": {"controller": "pid", "seed": 4}}, "'seed' is given under 'arguments' and under 'over'"),
        ({"arguments": {"controller": "pid", "model": "none.yaml"}}, "none.yaml: there is no such file"),
        ({"arguments": {"controller": "pid", "figure": "../f.png"}}, "figure must be a file name of its own"),
        ({"arguments": {"controller": "pid", "keep": "result.json"}}, "keep must be a file name of its own"),
        ({"arguments": {"controller": "pid", "noise": "no"}}, "noise must be true or false"),
        ({"arguments": {"controller": "pid", "plants": [1, 2]}}, "plants takes one value"),
        ({"arguments": {"controller": "pid", "plants": "many"}}, "plants must be a whole number, found 'many'"),
        ({"arguments": {"controller": "pid", "plants": 1.5}}, "plants must be a whole number, found 1.5"),
        ({"arguments": {"controller": "pid", "magnitude": "x"}}, "magnitude must be a number, found 'x'"),
        ({"arguments": {"controller": "pid", "task": "hoover"}}, "--task hoover: choose from hover"),
        ({"arguments": {}}, "cfb fly needs controller"),
        ({"arguments": {"controller": "pid", "set": "climb_s=1"}}, "set must be a mapping"),
        ({"arguments": {"controller": "{who}"}}, "needs a varied value called who"),
        ({"over": None}, "nothing varies"),
        ({"over": {"seed": []}}, "over.seed must be a list of values"),
        ({"over": {"seed": 3}}, "over.seed must be a list of values"),
        ({"over": {"sede": [1]}}, "over.sede is not an argument of cfb fly, and no argument contains {sede}"),
        ({"over": {"seed": [1, 2, 1]}}, "two tasks are called 'seed=1'"),
        ({"over": {"seed.x": [1]}}, "over.seed.x is not an argument"),
        ({"each": []}, "'each' must be a list of mappings"),
        ({"each": [{}]}, "'each' must be a list of mappings"),
        ({"each": "drones/*"}, "'each' must be a list of mappings"),
        ({"each": {"model": "a*", "on": "b*"}}, "'each' must be a list of mappings"),
        ({"each": {"model": "nowhere/*.yaml"}}, "each.model: nothing matches nowhere/*.yaml"),
        ({"each": [{"seed": 3}]}, "'seed' is given under 'over' and under 'each'"),
        ({"each": [{"model": "cfb", "name": "x"}, {"model": "cfb-guards", "name": "X"}]}, "two tasks are called"),
        ({"cpus": 0}, "'cpus' must be a positive number"),
        ({"cpus": "all"}, "'cpus' must be a positive number"),
        ({"cpus": 1.5}, "'cpus' above 1 must be a whole number"),
        ({"gpus": -1}, "'gpus' must be a zero or positive number"),
        ({"gpus": float("nan")}, "'gpus' must be a zero or positive number"),
        ({"command": "fit", "arguments": {"logs": "drones/c/*"}, "over": {"robust": [True]}}, "matches drones/c/*"),
        (
            {"command": "fit", "arguments": {"logs": "empty"}, "over": {"robust": [True]}},
            "this folder has no flight log",
        ),
        ({"command": "fit", "arguments": {"logs": []}, "over": {"robust": [True]}}, "logs must be a value or a list"),
    ],
)
def test_a_bad_file_is_refused_in_one_sentence(tasks, changes, said):
    keys = {key: value for key, value in (FLY | changes).items() if value is not None}
    with pytest.raises(CfbError) as refused:
        tasks(**keys)
    assert said in str(refused.value)
    assert "sweep.yaml" in str(refused.value)
    assert "\n" not in str(refused.value)


def test_days_are_names_not_dates(tasks):
    Path("drones/2026-01-31").mkdir()
    Path("drones/2026-01-31/1.mcap").write_text("")
    found = tasks(command="fit", arguments={"logs": "drones/{day}"}, each=[{"day": date(2026, 1, 31)}])
    assert lines(found)["day=2026-01-31"].startswith("cfb fit drones/2026-01-31/1.mcap")


def test_every_task_is_given_the_plugins_of_the_sweep_and_of_its_file(tasks, tmp_path):
    for name in ("a.py", "b.py"):
        (tmp_path / name).write_text("")
    found = tasks(command="fly", arguments={"controller": "pid", "plugin": "b.py"}, over={"seed": [0, 1]})
    assert [task.line for task in found] == [f"cfb fly pid --seed {i} --plugin b.py --json result.json" for i in (0, 1)]
    found = tasks_of(load_sweep("sweep.yaml", load, [Path("a.py")]))
    for task in found:
        assert task.arguments[-4:] == ("--plugin", "a.py", "--plugin", "b.py")
        assert parse("fly", task.words(Path("."))[1:]).plugin == (Path("a.py"), Path("b.py"))
    with pytest.raises(CfbError, match=r"plugin: nothing matches none\.py"):
        tasks(command="fly", arguments={"controller": "pid", "plugin": "none.py"}, over={"seed": [0]})


def test_a_sweep_hands_its_plugin_to_its_tasks(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text("")
    Path("sweep.yaml").write_text(yaml.safe_dump({"format": "cfb_mjx sweep 1"} | FLY))
    assert main(["sweep", "sweep.yaml", "--plugin", "mine.py", "-o", "out", "--dry-run"]) == 0
    assert capsys.readouterr().out.count("--plugin mine.py") == 2
