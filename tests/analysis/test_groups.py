"""Which missions of two settings are one pair: the rule, written out with dicts, is the oracle."""

import numpy as np
import pyarrow as pa
from hypothesis import given
from hypothesis import strategies as st

from mavfi_cli.analysis.summary import METRICS, Group
from mavfi_cli.campaigns.missions import Injected
from mavfi_cli.stats.paired import McNemar

FATES = (Injected.ACTIVE.value, Injected.NOT_INJECTED.value)
PAIRS = "abcd"
MISSIONS = st.lists(st.tuples(st.sampled_from(PAIRS), st.booleans()), max_size=12)


def group(missions, fates=FATES):
    """A setting of missions of a pair each, which count or do not."""
    counted, other = fates
    count = len(missions)
    columns = {
        "number": np.arange(count),
        "outcome": pa.array(["success"] * count, pa.string()),
        "injected": pa.array([counted if c else other for _, c in missions], pa.string()),
        "cell": np.zeros(count, dtype=np.int64),
        "stratum": pa.nulls(count, pa.string()),
        "weight": np.ones(count),
        "pair": np.array([PAIRS.index(pair) for pair, _ in missions], dtype=np.int64),
        "strike": np.zeros(count, dtype=np.int64),
        **{name: np.zeros(count) for name in METRICS},
    }
    return Group(
        labels={}, lacked=(), planned=count, errors=0, watched=False, flights=pa.table(columns)
    )


def expected(first, second, *, golden):
    """The k-th mission of a pair with the k-th; one golden one with all."""
    found, met = [], dict.fromkeys(PAIRS, 0)
    for place, (pair, counts) in enumerate(second):
        if not counts:
            continue
        others = [at for at, each in enumerate(first) if each == (pair, True)]
        wanted = 0 if golden else met[pair]
        met[pair] += 1
        if wanted < len(others):
            found.append((others[wanted], place))
    return found


@given(first=MISSIONS, second=MISSIONS)
def test_missions_of_a_pair_meet_one_by_one(first, second):
    found = group([*first, ("a", True)]).matched(group(second))
    assert list(zip(*map(np.ndarray.tolist, found), strict=True)) == expected(
        [*first, ("a", True)], second, golden=False
    )


@given(pairs=st.lists(st.sampled_from(PAIRS), max_size=12), second=MISSIONS)
def test_one_golden_flight_serves_all_of_its_pair(pairs, second):
    first = [(pair, True) for pair in pairs]
    found = group(first, (Injected.GOLDEN.value,) * 2).matched(group(second))
    assert list(zip(*map(np.ndarray.tolist, found), strict=True)) == expected(
        first, second, golden=True
    )


@given(missions=MISSIONS)
def test_words_are_counted_as_they_stand(missions):
    whole = group(missions)
    fates = [FATES[not counts] for _, counts in missions]
    assert whole.counts("injected") == {fate: fates.count(fate) for fate in sorted(set(fates))}
    assert whole.counted.tolist() == [counts for _, counts in missions]
    known = {PAIRS.index(pair) for pair, counts in missions if counts}
    assert whole.pairs.tolist() == sorted(known)


def test_faults_in_one_invocation_count_as_much_as_their_clusters_say():
    """Of four clusters of five, one is lost whole, as if one of four missions were."""
    whole = group([(pair, True) for pair in PAIRS for _ in range(5)])
    lost = np.array([pair == "a" for pair in PAIRS for _ in range(5)])
    share, chosen = whole.share(lost, np.ones(20, bool)), np.ones(4, bool)
    alone = group([(pair, True) for pair in PAIRS]).share(lost[::5], chosen)
    assert (share.count, share.total) == (5, 20)
    assert share.low <= alone.low
    assert share.high >= alone.high
    mixed = np.arange(20) % 5 == 0
    assert whole.share(mixed, np.ones(20, bool)).high < share.high
    both = McNemar.of(~lost, np.ones(20, bool), clusters=whole.clusters)
    assert McNemar.of(~lost, np.ones(20, bool)).p_value < 0.1 < both.p_value
    assert group([(pair, True) for pair in PAIRS]).clusters is None
