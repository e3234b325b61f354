import numpy as np
import pytest

from mavfi_cli.core.types import Stage
from mavfi_cli.detect.gaussian import SIGMA_FLOORS, GaussianDetector
from mavfi_cli.detect.preprocess import COUNT, NAMES

X = NAMES.index("waypoint_x")


def taught(values, n_sigma=4.0):
    detector = GaussianDetector.cold(n_sigma)
    for value in values:
        deltas = np.zeros(COUNT, np.int16)
        deltas[X] = value
        detector.learn(deltas, Stage.PLANNING)
    return detector


def score(detector, value):
    deltas = np.zeros(COUNT, np.int16)
    deltas[X] = value
    return detector.score(deltas, Stage.PLANNING)


def test_the_recurrences_of_the_paper():
    """Equations 1 and 2 with M_1 = x_1, S_1 = 0, in exact arithmetic as an oracle."""
    from fractions import Fraction

    values = np.random.default_rng(1).integers(-40, 60, size=200).tolist()
    detector = taught(values)
    mean, total = Fraction(values[0]), Fraction(0)
    for k, value in enumerate(values[1:], start=2):
        before = mean
        mean += (value - before) / Fraction(k)
        total += (value - before) * (value - mean)
    memory = detector.memory
    assert memory["count"][X] == len(values)
    assert memory["mean"][X] == pytest.approx(float(mean), rel=1e-13)
    assert memory["sum_of_squares"][X] == pytest.approx(float(total), rel=1e-13)
    sigma = float(np.std(values, ddof=1))
    assert score(detector, 500) == pytest.approx((500 - np.mean(values)) / sigma, rel=1e-12)


def test_the_first_sample_is_the_mean():
    memory = taught([7]).memory
    assert (memory["count"][X], memory["mean"][X], memory["sum_of_squares"][X]) == (1, 7, 0)


def test_a_state_that_never_changes_has_the_floor_as_sigma():
    floor = SIGMA_FLOORS[Stage.PLANNING]
    for detector in (taught([]), taught([0]), taught([0] * 1000)):
        assert score(detector, 3) == pytest.approx(3 / floor)


def test_the_worst_state_of_the_stage_decides_and_only_its_stage_learns():
    detector = taught([0, 1] * 50)
    deltas = np.full(COUNT, 2, np.int16)
    assert detector.score(deltas, Stage.PLANNING) == pytest.approx(2 / 0.3)
    before = detector.memory["count"].copy()
    detector.learn(deltas, Stage.CONTROL)
    assert (detector.memory["count"] - before).tolist() == [0] * 9 + [1] * 4


def test_a_negative_sum_of_squares_is_an_alarm():
    detector = taught([0, 1] * 50)
    detector.memory["sum_of_squares"][X] = -1.0
    assert not score(detector, 0) <= detector.threshold
