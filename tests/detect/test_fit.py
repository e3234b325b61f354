import sys

import numpy as np
import pytest
from detect_builders import STACK

from mavfi_cli.core.errors import ConfigError, ModelError, UnknownName
from mavfi_cli.core.types import Stage
from mavfi_cli.detect import base, fit
from mavfi_cli.detect.dataset import Dataset, FlightSamples
from mavfi_cli.detect.preprocess import COUNT, NAMES, PreprocessParams
from mavfi_cli.detect.watch import EXTENDED


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


def parts_of(dataset, places):
    return [dataset.flights[place] for place in places]


def test_the_split_is_by_flight_alike_in_each_world_and_drawn(dataset):
    split = fit.split(dataset, 1)
    parts = [split["train"], split["validation"], split["threshold"]]
    assert [len(part) for part in parts] == [10, 2, 8]
    assert sorted(place for part in parts for place in part) == list(range(20))
    for part in parts:
        worlds = [dataset.flights[place].world for place in part]
        assert abs(worlds.count("w0") - worlds.count("w1")) <= 0
    assert fit.split(dataset, 1) == split != fit.split(dataset, 2)


def test_too_few_flights_are_refused(dataset):
    few = Dataset(flights=dataset.flights[:9], preprocess=dataset.preprocess, stack=STACK)
    for kind in fit.KINDS:
        with pytest.raises(ModelError, match="9 flights are too few to fit to: 10 at least"):
            fit.fit(kind, few)


def test_bad_requests(dataset):
    with pytest.raises(UnknownName, match="unknown detector 'x'; known: aad, gad, l2, range"):
        fit.fit("x", dataset)
    with pytest.raises(ConfigError, match="n sigma"):
        fit.fit("gad", dataset, n_sigma=-1.0)


def test_gad_is_warmed_by_the_flights_that_set_no_threshold(dataset):
    fitted = fit.fit("gad", dataset, n_sigma=6.5)
    split = fit.split(dataset, 1)
    learned = parts_of(dataset, [*split["train"], *split["validation"]])
    x = np.concatenate([each.of_stage(Stage.PLANNING) for each in learned])[:, 2].astype(float)
    assert fitted.arrays["count"][2] == len(x)
    assert fitted.arrays["mean"][2] == pytest.approx(x.mean())
    assert fitted.arrays["sum_of_squares"][2] == pytest.approx(((x - x.mean()) ** 2).sum())
    assert fitted.arrays["n_sigma"][0] == fitted.provenance["threshold"] == 6.5


@pytest.mark.parametrize("kind", ["l2", "aad"])
def test_a_threshold_is_the_largest_score_of_flights_that_training_did_not_see(
    dataset, kind, quick, tmp_path
):
    fitted = fit.fit(kind, dataset)
    fitted.save(tmp_path / "m.json")
    detector = base.find_detector(kind, model=tmp_path / "m.json")
    held_out = parts_of(dataset, fit.split(dataset, 1)["threshold"])
    images = fit.mirrored(np.concatenate([each.deltas for each in held_out])).astype(np.int16)
    largest = max(detector.score(deltas, Stage.CONTROL) for deltas in images)
    assert detector.threshold == largest > 0.0
    for each in held_out:
        assert (fit.scores(detector, each) <= detector.threshold).all()


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


def test_mirror_images():
    row = np.zeros((1, COUNT), np.int16)
    place = NAMES.index
    row[0, [place("waypoint_x"), place("command_vy"), place("command_yaw")]] = 2, 3, 1
    images = {tuple(image) for image in fit.mirrored(row).tolist()}
    assert len(images) == 8
    assert tuple(row[0].tolist()) in images
    assert all(sorted(map(abs, image)) == [0] * 10 + [1, 2, 3] for image in images)
    assert {abs(image[place("command_yaw")]) for image in images} == {1}
    swapped = [image for image in images if image[place("waypoint_y")] != 0]
    assert len(swapped) == 4
    assert all(abs(image[place("command_vx")]) == 3 for image in swapped)


def test_components_of_a_vector_share_their_scale(dataset):
    (one,) = [each for each in dataset.flights if each.seed == 0]
    deltas = one.deltas.copy()
    deltas[5, NAMES.index("command_vz")] = -4
    changed = FlightSamples(
        world="w", seed=99, stamps_s=one.stamps_s, reports=one.reports,
        plan_steps=one.plan_steps, new_waypoint=one.new_waypoint, deltas=deltas,
        extended=one.extended,
    )  # fmt: skip
    assert fit.scale_of([changed]).tolist() == [1, 2, 1, 1, 1, 1, 1, 1, 1, 4, 4, 4, 1]


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


def test_trained_weights_reconstruct_better_than_the_first_ones(quick):
    rows = fit.mirrored(flight("w", 1, 400).deltas).astype(float)
    trained = fit.train_autoencoder(rows, rows, seed=1)
    curve = np.array(trained.provenance["loss_curve"]["rows"])
    assert trained.provenance["validation_error"] < curve[0, 2]


def test_without_torch_only_the_autoencoder_is_missing(dataset, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    for begin in (lambda: fit.check(fit.KINDS, 100), lambda: fit.fit("aad", dataset)):
        with pytest.raises(ModelError, match=r"needs torch: pip install 'mavfi\[train\]'"):
            begin()
    fit.check(["gad", "l2", "range"], 100)
    assert fit.fit("l2", dataset).detector == "l2"
