import itertools
import sys
from dataclasses import replace

import numpy as np
import pytest
from detect_builders import STACK

from mavfi_cli.core.errors import ConfigError, ModelError, UnknownName
from mavfi_cli.core.types import Stage
from mavfi_cli.detect import base, fit
from mavfi_cli.detect.offline import Dataset, FlightSamples
from mavfi_cli.detect.preprocess import COUNT, EXTENDED, NAMES, PreprocessParams


def flight(world, seed, rows=120):
    """A made-up flight: most samples bring no change, some a step of one."""
    rng = np.random.default_rng(seed)
    deltas = (rng.integers(-1, 2, (rows, COUNT)) * (rng.random((rows, COUNT)) < 0.1)).astype(
        np.int16
    )
    reports = np.arange(rows) % 16 == 0
    deltas[reports, 2:] = 0
    new = (np.arange(rows) % 25 == 1) & ~reports
    deltas[~new, 2:9] = 0
    stamps = np.arange(rows) * 0.02
    return FlightSamples(
        world=world,
        seed=seed,
        stamps_s=stamps,
        reports=reports,
        new_waypoint=new,
        deltas=deltas,
        plan_steps=np.zeros(rows, bool),
        extended=np.repeat([[seed % 3, 0, -(seed % 4)]], rows, axis=0).astype(np.int16),
    )


@pytest.fixture(scope="module")
def dataset():
    flights = tuple(flight(f"w{seed % 2}", seed) for seed in range(20))
    return Dataset(flights=flights, preprocess=PreprocessParams(), stack=STACK)


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(fit, "EPOCHS", 40)
    monkeypatch.setattr(fit, "STARTS", 2)


def parts_of(dataset, model, *uses):
    """The flights of some parts of a model's split."""
    named = {f"{each.world}/{each.seed}": each for each in dataset.flights}
    return [named[name] for use in uses for name in model.provenance["split"][use]]


def images_of(rows):
    """Deltas and their mirror images, each written out."""
    axes = [(NAMES.index(f"{p}x"), NAMES.index(f"{p}y"))
            for p in ("waypoint_", "waypoint_v", "command_v")]  # fmt: skip
    yaws = NAMES.index("waypoint_yaw"), NAMES.index("command_yaw")
    for row in rows:
        for swapped, east, north in itertools.product((False, True), (1, -1), (1, -1)):
            image = row.copy()
            for x, y in axes:
                image[x] = east * row[y if swapped else x]
                image[y] = north * row[x if swapped else y]
            for yaw in yaws:
                image[yaw] = north * row[yaw]
            yield image


def with_deltas(dataset, **changes):
    """The same flights, with other values in the sixth row of each."""
    flights = []
    for each in dataset.flights:
        deltas = each.deltas.copy()
        for name, value in changes.items():
            deltas[5, NAMES.index(name)] = value
        flights.append(replace(each, deltas=deltas))
    return replace(dataset, flights=tuple(flights))


def test_the_split_is_by_flight_alike_in_each_world_and_drawn(dataset):
    fitted, again, other = (fit.fit("l2", dataset, seed=seed) for seed in (1, 1, 2))
    split = fitted.provenance["split"]
    parts = [split["train"], split["validation"], split["threshold"]]
    assert [len(part) for part in parts] == [10, 2, 8]
    flights = sorted(name for part in parts for name in part)
    assert flights == sorted(f"{each.world}/{each.seed}" for each in dataset.flights)
    assert sorted(fitted.training_flights) == flights
    for part in parts:
        assert 2 * sum(name.startswith("w0/") for name in part) == len(part)
    assert again.provenance["split"] == split != other.provenance["split"]


def test_too_few_flights_are_refused(dataset):
    few = Dataset(flights=dataset.flights[:9], preprocess=dataset.preprocess, stack=STACK)
    for kind in fit.KINDS:
        with pytest.raises(ModelError, match="at least 10, got 9"):
            fit.fit(kind, few)


def test_bad_requests(dataset):
    with pytest.raises(UnknownName, match=r"'x'.* aad, gad, l2, range"):
        fit.fit("x", dataset)
    with pytest.raises(ConfigError, match="n sigma"):
        fit.fit("gad", dataset, n_sigma=-1.0)


def test_gad_is_warmed_by_the_flights_that_set_no_threshold(dataset):
    fitted = fit.fit("gad", dataset, n_sigma=6.5)
    learned = parts_of(dataset, fitted, "train", "validation")
    x = np.concatenate([each.of_stage(Stage.PLANNING) for each in learned])[:, 2].astype(float)
    assert fitted.arrays["count"][2] == len(x)
    assert fitted.arrays["mean"][2] == pytest.approx(x.mean())
    assert fitted.arrays["sum_of_squares"][2] == pytest.approx(((x - x.mean()) ** 2).sum())
    assert fitted.arrays["n_sigma"][0] == fitted.provenance["threshold"] == 6.5


def test_a_threshold_of_gad_leaves_room_for_what_it_learns_in_flight(dataset, monkeypatch):
    monkeypatch.setattr(fit, "_largest", lambda *_: 16.0)
    fitted = fit.fit("gad", dataset)
    assert fitted.provenance["threshold"] == 17.0


@pytest.mark.parametrize("kind", ["l2", pytest.param("aad", marks=pytest.mark.slow)])
def test_a_threshold_is_the_largest_score_of_flights_that_training_did_not_see(
    dataset, kind, quick, tmp_path
):
    fitted = fit.fit(kind, dataset)
    fitted.save(tmp_path / "m.json")
    detector = base.find_detector(kind, model=tmp_path / "m.json")
    held_out = parts_of(dataset, fitted, "threshold")
    rows = np.unique(np.concatenate([each.deltas for each in held_out]), axis=0)
    largest = max(detector.score(deltas, Stage.CONTROL) for deltas in images_of(rows))
    assert detector.threshold == largest > 0.0
    for each in held_out:
        assert (each.scores(detector) <= detector.threshold).all()


def test_range_holds_all_flights_and_their_mirror_images(dataset):
    fitted = fit.fit("range", dataset)
    seen = np.concatenate([each.deltas for each in dataset.flights])
    seq, x, y = (NAMES.index(n) for n in ("future_collision_seq", "waypoint_x", "waypoint_y"))
    assert fitted.arrays["lowest"][seq] == seen[:, seq].min() < 0
    assert fitted.arrays["highest"][seq] == seen[:, seq].max() > 0
    widest = np.abs(seen[:, [x, y]]).max()
    for place in (x, y):
        assert fitted.arrays["highest"][place] == -fitted.arrays["lowest"][place] == widest


@pytest.mark.parametrize("kind", ["gad", "range", "l2"])
def test_a_model_tells_its_stack_and_what_all_flights_showed_of_the_extended_states(dataset, kind):
    fitted = fit.fit(kind, dataset)
    assert fitted.stack == STACK
    assert list(fitted.extended.values()) == [(0, 2), (0, 0), (-3, 0)]
    assert list(fitted.extended) == [state.name for state in EXTENDED]


def test_mirror_images(dataset):
    """East and north are mirrored and swapped; yaw is negated, and never swapped."""
    fitted = fit.fit("range", with_deltas(dataset, waypoint_x=20, command_vy=30, command_yaw=10))
    widest = {"waypoint_x": 20, "waypoint_y": 20, "command_vx": 30, "command_vy": 30,
              "command_yaw": 10}  # fmt: skip
    for name, value in widest.items():
        place = NAMES.index(name)
        assert fitted.arrays["highest"][place] == -fitted.arrays["lowest"][place] == value
    others = [place for place, name in enumerate(NAMES) if name not in widest]
    assert np.abs(fitted.arrays["highest"][others]).max() <= 1


def test_components_of_a_vector_share_their_scale(dataset):
    fitted = fit.fit("l2", with_deltas(dataset, command_vz=-4))
    assert fitted.arrays["scale"].tolist() == [1, 2, 1, 1, 1, 1, 1, 1, 1, 4, 4, 4, 1]


@pytest.mark.slow
def test_training_is_deterministic_and_tells_what_it_did(dataset, quick):
    first, second = fit.fit("aad", dataset, seed=4), fit.fit("aad", dataset, seed=4)
    for name, array in first.arrays.items():
        np.testing.assert_array_equal(array, second.arrays[name])
    assert first.provenance == second.provenance
    told = first.provenance
    assert (told["seed"], told["epochs"], told["starts"]) == (4, 40, 2)
    assert told["versions"]["torch"]
    curve = np.array(told["loss_curve"]["rows"])
    assert curve.shape == (3, 3)
    assert curve[-1, 1] < curve[0, 1]
    assert sum(len(part) for part in told["split"].values()) == told["flights"] == 20


@pytest.mark.slow
def test_trained_weights_reconstruct_better_than_the_first_ones(dataset, quick):
    told = fit.fit("aad", dataset).provenance
    assert told["validation_error"] < told["loss_curve"]["rows"][0][2]


def test_without_torch_only_the_autoencoder_is_missing(dataset, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    for begin in (lambda: fit.check(fit.KINDS, 100), lambda: fit.fit("aad", dataset)):
        with pytest.raises(ModelError, match=r"needs torch: pip install 'mavfi\[train\]'"):
            begin()
    fit.check(["gad", "l2", "range"], 100)
    assert fit.fit("l2", dataset).detector == "l2"
