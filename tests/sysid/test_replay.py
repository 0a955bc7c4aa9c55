"""Walking beside flights: shortcuts say what the whole model says, and one program serves all rows."""

from __future__ import annotations

import threading

import jax
import numpy as np
import pytest

from cfb_mjx import devices
from cfb_mjx.files import shipped
from cfb_mjx.logs import read_log
from cfb_mjx.model import CATALOGUE, Quadrotor
from cfb_mjx.sysid import replay
from cfb_mjx.sysid.flight import prepare_flight
from cfb_mjx.sysid.replay import Lane, remembered_along, replays, speeds_along
from cfb_mjx.sysid.tracing import signals
from cfb_mjx.sysid.tracing.search import Search
from cfb_mjx.sysid.tracing.sensors import check_sensors


@pytest.fixture(scope="module")
def flights():
    logs = [read_log(path) for path in sorted(shipped("data", "flight_logs").glob("*.mcap"))[:2]]
    return [prepare_flight(log.rows(np.arange(len(log.time)) < 700), 0.0, 0.0) for log in logs]


@pytest.fixture(scope="module")
def model():
    """With every effect, none of them neutral."""
    middle = ({key: 0.3 * low + 0.7 * high for key, (low, high) in kind.prior.items()} for kind in CATALOGUE.values())
    effects = tuple(kind(**values) for kind, values in zip(CATALOGUE.values(), middle, strict=True))
    return Quadrotor(Quadrotor.from_file("cfb-guards").parameters, effects)


def test_rotor_speeds_alone_are_those_of_the_whole_model(model, flights):
    whole = remembered_along(model, flights, 0.1)
    for alone, (speed, _) in zip(speeds_along(model, flights, 0.1), whole, strict=True):
        assert len(alone) > 512
        np.testing.assert_array_equal(alone, speed)


def test_chosen_rows_are_those_of_all(model, flights):
    chosen = [np.array([0, 511, 512, 512, 699]), np.zeros(0, dtype=int)]
    every = remembered_along(model, flights, 0.1)
    for rows, whole, some in zip(chosen, every, remembered_along(model, flights, 0.1, chosen), strict=True):
        jax.tree.map(lambda x, y, rows=rows: np.testing.assert_array_equal(y, x[rows]), whole, some)


def test_one_program_serves_all_rows(model, flights):
    """A weak type in what is carried on would make the second group of rows a program of its own."""
    effects = jax.tree.map(lambda x: np.asarray(x)[None], model.effects)
    rows = replay._rows([Lane(flights[0], flights[0].rotor_speed)], replay._READ, 0, 10)
    begun = replay._begin(model, effects, {key: x[:, :2] for key, x in rows.items()})
    after = jax.eval_shape(
        lambda carry: replay._advance(model, effects, np.zeros(1), np.zeros(1), rows, carry, "speed")[0], begun
    )
    for x, y in zip(jax.tree.leaves(begun), jax.tree.leaves(after), strict=True):
        assert (x.dtype, x.weak_type) == (y.dtype, y.weak_type)


def test_groups_on_several_cores_say_the_same(flights, monkeypatch):
    model = Quadrotor.from_file("cfb-guards")
    lanes = [Lane(flight, flight.rotor_speed, lead) for lead in np.linspace(0, 0.5, 70) for flight in flights]
    monkeypatch.setattr(replay, "LANES", (8, 32))
    found = []
    for count in (1, 3):
        monkeypatch.setattr(devices, "cores", lambda count=count: count)
        found.append(list(replays(model, iter(lanes))))
    jax.tree.map(np.testing.assert_array_equal, *found)


def test_a_flight_in_pieces_says_what_it_says_at_once(monkeypatch):
    """A long flight is replayed and whitened in pieces, so that its memory is bounded; a search must not notice."""
    logs = [read_log(path) for path in sorted(shipped("data", "flight_logs").glob("*.mcap"))[:2]]
    parameters = Quadrotor.from_file("cfb-guards").parameters
    delay = 0.008
    search = Search.start(logs, parameters, delay, check_sensors(logs, delay, 0.0), named=("rotor_drag", "inflow"))
    hypothesis = search.nothing()
    wanted = [column for variant in search.candidates(hypothesis)[:6] for column in variant]
    found = []
    for most, piece in ((replay.MOST, signals.PIECE), (0, 1)):
        monkeypatch.setattr(signals, "MOST", most)
        monkeypatch.setattr(signals, "PIECE", piece)
        found.append([search.linearise(hypothesis, wanted), *search.linearise_terms(hypothesis, wanted[:2])[1:5:3]])
    for whole, pieces in zip(*found, strict=True):
        np.testing.assert_array_equal(whole.fold, pieces.fold)
        np.testing.assert_allclose(pieces.scale, whole.scale, rtol=1e-12)
        size = np.sqrt(np.einsum("bii->bi", whole.blocks)) + 1e-30
        assert len(whole.blocks) > 8
        assert np.max(np.abs(whole.blocks - pieces.blocks) / (size[:, :, None] * size[:, None, :])) < 1e-9


def test_over_cores_keeps_order_precision_and_errors(monkeypatch):
    monkeypatch.setattr(devices, "cores", lambda: 3)
    threads = set()

    def function(i):
        threads.add(threading.get_ident())
        if i == 7:
            raise ValueError("seven")
        return i, str(jax.numpy.zeros(1).dtype)

    for x64 in (True, False):
        with jax.enable_x64(x64):
            assert list(devices.over_cores(function, range(6))) == [
                (i, "float64" if x64 else "float32") for i in range(6)
            ]
    assert len(threads) > 1
    with pytest.raises(ValueError, match="seven"):
        list(devices.over_cores(function, range(10)))
    assert list(devices.over_cores(function, [])) == []
