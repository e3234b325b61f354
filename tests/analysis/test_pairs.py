"""Two treatments of the same missions, against numbers made by hand."""

import math

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavfi_cli.analysis.flights import changed, chosen, flags, known, numbers
from mavfi_cli.analysis.pairs import paired, partners
from mavfi_cli.stats.paired import McNemar


def flown(*ends, seeds=None):
    """Flights of 10 s each that ended so; a seed each."""
    return pa.table(
        {
            "seed": list(seeds or range(len(ends))),
            "succeeded": [end == "success" for end in ends],
            "time_s": pa.array([10.0] * len(ends)),
        }
    )


KEYS = st.lists(st.tuples(st.sampled_from([1, 2, None]), st.sampled_from(["a", "b"])), max_size=9)


def keyed(keys):
    return pa.table({name: [key[at] for key in keys] for at, name in enumerate(("seed", "world"))})


@given(rows=KEYS, others=KEYS, repeats=st.booleans(), data=st.data())
def test_a_partner_is_the_first_row_of_equal_keys_or_the_equally_numbered_one(
    rows, others, repeats, data
):
    only = data.draw(st.lists(st.booleans(), min_size=len(others), max_size=len(others)))
    found = partners(
        keyed(rows), keyed(others), ("world", "seed"), only=np.array(only, bool), repeats=repeats
    )
    for place, (key, partner) in enumerate(zip(rows, found, strict=True)):
        equal = [at for at, each in enumerate(others) if each == key and only[at]]
        number = rows[:place].count(key) if repeats else 0
        assert partner == (equal[number] if number < len(equal) else -1)


def test_paired_rows_keep_the_order_of_the_first_table():
    first, second = (
        flown(*["crash"] * 3, seeds=[2, 5, 3]),
        flown(*["success"] * 4, seeds=[3, 1, 2, 9]),
    )
    here, there = paired(first, second, ["seed"])
    assert here["seed"].to_pylist() == there["seed"].to_pylist() == [2, 3]
    assert not flags(here, "succeeded").any()
    assert flags(there, "succeeded").all()
    none, nothing = paired(first.slice(0, 0), second, ["seed"])
    assert (none.num_rows, nothing.num_rows) == (0, 0)


def test_columns_tell_what_is_missing():
    table = pa.table({"a": [1, None, 3], "b": pa.array([None] * 3), "c": ["x", "y", None]})
    assert known(numbers(table, "a")).tolist() == [1.0, 3.0]
    assert np.isnan(numbers(table, "b")).all()
    assert chosen(table, c="x")["a"].to_pylist() == [1]
    assert chosen(table, b="x").num_rows == 0


def test_a_ratio_is_the_geometric_mean_and_turns_round():
    found = changed(range(2), [10.0, 20.0], [20.0, 80.0])
    assert found.count == 2
    assert found.value == pytest.approx(math.sqrt(2.0 * 4.0))
    assert 2.0 - 1e-9 <= found.low <= found.value <= found.high <= 4.0 + 1e-9
    back = changed(range(2), [20.0, 80.0], [10.0, 20.0])
    assert back.value == pytest.approx(1.0 / found.value)


def test_several_pairs_of_one_mission_are_one_value():
    assert changed([1, 1, 2], [1.0, 1.0, 1.0], [2.0, 8.0, 4.0]).count == 2
    assert changed([1, 1, 2], [0.0, 0.0, 0.0], [2.0, 4.0, 5.0], ratio=False).value == 4.0


def test_what_is_no_positive_number_is_left_out_of_a_ratio():
    assert changed(range(3), [0.0, 1.0, math.nan], [1.0, 3.0, 1.0]).value == pytest.approx(3.0)
    assert changed(range(2), [0.0, math.nan], [1.0, 3.0], ratio=False).value == 1.0


def test_nothing_to_compare_is_no_number():
    found = changed([], [], [])
    assert found.count == 0
    assert math.isnan(found.value)


def test_the_interval_holds_the_ratio_that_was_put_in():
    rng = np.random.default_rng(3)
    first = rng.uniform(10.0, 30.0, 40)
    second = 1.3 * first * np.exp(rng.normal(0.0, 0.05, 40))
    found = changed(range(40), first.tolist(), second.tolist())
    assert found.low < 1.3 < found.high
    assert found.high - found.low < 0.1


def test_success_of_pairs():
    first = flown("success", "success", "collision", "success")
    second = flown("timeout", "success", "timeout", "timeout")
    test = McNemar.of(*(flags(each, "succeeded") for each in (first, second)))
    assert (test.both, test.only_first, test.neither) == (1, 2, 1)
