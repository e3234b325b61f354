"""The rule of the verdicts: a test against the nearest end of the range, corrected by family."""

import math

import pytest

from mavfi_cli.paper.claims import excludes
from mavfi_cli.paper.verdicts import Finding, FirstLook, Verdict, judge, margin
from mavfi_cli.stats.shares import Interval, wilson

FREE = (-math.inf, math.inf)
UP = math.inf


def between(low, high, count=100):
    return Finding(effect=Interval(value=(low + high) / 2, low=low, high=high, count=count))


def alone(finding, low, high):
    (judgement,) = judge([finding], [(low, high)])
    return judgement


@pytest.mark.parametrize(
    ("finding", "low", "high", "verdict"),
    [
        (between(0.1, 0.2), 0.05, UP, Verdict.REPRODUCED),
        (between(0.1, 0.2), 0.11, UP, Verdict.UNDECIDED),
        (between(0.1, 0.2), 0.25, UP, Verdict.CONTRADICTED),
        (between(0.1, 0.2), 0.05, 0.25, Verdict.REPRODUCED),
        (between(0.1, 0.2), 0.05, 0.18, Verdict.UNDECIDED),
        (between(0.1, 0.2), -0.05, 0.05, Verdict.CONTRADICTED),
        (between(-0.01, 0.01), -0.02, 0.02, Verdict.REPRODUCED),
        (between(-0.03, 0.03), -0.02, 0.02, Verdict.UNDECIDED),
        (between(-0.3, -0.2), -UP, -0.1, Verdict.REPRODUCED),
        (between(math.nan, math.nan), 0.0, UP, Verdict.NOT_DECIDABLE),
        (Finding(why="not flown"), 0.0, UP, Verdict.NOT_DECIDABLE),
    ],
)
def test_the_nearest_end_of_the_range_decides(finding, low, high, verdict):
    assert alone(finding, low, high).verdict is verdict


def test_the_test_is_that_of_the_interval():
    """An end of the range at an end of the 95 % interval has p = 0.05."""
    assert alone(between(0.1, 0.2), 0.1, UP).p == pytest.approx(0.05)
    assert alone(between(0.1, 0.2), 0.2, UP).p == pytest.approx(0.05)
    assert alone(between(0.1, 0.2), 0.15, UP).p == pytest.approx(1.0)


def test_an_undecided_claim_says_how_many_missions_decide():
    judgement = alone(between(0.0, 0.2, count=100), 0.05, UP)
    assert judgement.needed == pytest.approx(100 * (0.1 / 0.05) ** 2)
    half = 0.1 * math.sqrt(100 / judgement.needed)
    more = between(0.1 - half * 0.999, 0.1 + half * 0.999, count=round(judgement.needed))
    assert alone(more, 0.05, UP).verdict is Verdict.REPRODUCED
    assert alone(between(0.0, 0.25), 0.125, UP).needed == math.inf
    assert alone(between(0.1, 0.2), 0.05, UP).needed == 0.0


def test_a_family_is_corrected():
    weak, strong = between(0.1, 0.2), between(0.14, 0.16)
    assert alone(weak, 0.09, UP).verdict is Verdict.REPRODUCED
    several = judge([weak] * 4, [(0.09, UP)] * 4)
    assert {each.verdict for each in several} == {Verdict.UNDECIDED}
    first, *_ = judge([weak, strong, strong, strong], [(0.09, UP)] * 4)
    assert first.verdict is Verdict.REPRODUCED  # Holm: the last in the order is tested alone
    unflown = judge([weak, *[Finding(why="not flown")] * 3], [(0.09, UP)] * 4)
    assert unflown[0].verdict is Verdict.REPRODUCED  # what has no data is no test


@pytest.mark.parametrize("missions", [100, 200, 300, 400, 1200, 5000])
def test_a_margin_lets_a_family_of_four_come_out_either_way(missions):
    least = margin(missions)
    assert least == pytest.approx(round(200 * least) / 200)  # half points

    def verdicts(hits, low, high):
        share = Finding(effect=wilson(hits, missions).effect)
        return {each.verdict for each in judge([share] * 4, [(low, high)] * 4)}

    assert verdicts(0, least, UP) == {Verdict.CONTRADICTED}
    assert verdicts(round(4 * least * missions), least, UP) == {Verdict.REPRODUCED}
    assert verdicts(0, -least, least) == {Verdict.REPRODUCED}
    assert verdicts(round(4 * least * missions), -least, least) == {Verdict.CONTRADICTED}


def test_half_of_the_level_is_for_the_first_look_and_half_for_all_looks():
    finding, ends = between(0.1, 0.2), (0.05, UP)
    fixed = alone(finding, *ends)
    (look,) = judge([finding], [ends], [None])
    assert fixed.verdict is Verdict.REPRODUCED
    assert look.p > 2 * fixed.p
    assert (fixed.bounds, look.p_alone) == (None, fixed.p)
    assert look.bounds.low < 0.1 < 0.2 < look.bounds.high
    (first,) = judge([finding], [ends], [FirstLook(p=fixed.p, inside=True)])
    assert first.p == pytest.approx(2 * fixed.p)
    (other,) = judge([finding], [ends], [FirstLook(p=fixed.p, inside=False)])
    assert other.p == look.p


def test_a_settled_claim_needs_more_missions():
    finding = between(0.0, 0.2, count=100)
    (look,) = judge([finding], [(0.05, UP)], [None])
    assert look.needed > 2 * alone(finding, 0.05, UP).needed


def test_bounds_within_the_size_on_both_sides_exclude_an_effect_of_it():
    bounds = between(-0.003, 0.008).effect
    assert excludes(0.009, bounds)
    assert not excludes(0.007, bounds)
    assert not excludes(None, bounds)
    assert not excludes(0.009, None)
