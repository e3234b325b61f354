from hypothesis import given
from hypothesis import strategies as st

from mavfi_cli.core.seeds import Stream

seeds = st.integers(0, 2**31 - 1)


@given(seeds)
def test_a_stream_repeats(seed):
    draws = [Stream.PLANNER.generator(seed, 3).integers(2**62, size=4).tolist() for _ in range(2)]
    assert draws[0] == draws[1]
    assert Stream.WORLD.seed(seed) == Stream.WORLD.seed(seed)


@given(seeds)
def test_streams_are_separate(seed):
    draws = {tuple(stream.generator(seed).integers(2**62, size=2)) for stream in Stream}
    draws |= {tuple(Stream.LATENCY.generator(seed, d).integers(2**62, size=2)) for d in ("a", "b")}
    assert len(draws) == len(Stream) + 2


@given(seeds)
def test_a_derived_seed_fits_what_libraries_take(seed):
    assert 1 <= Stream.PLANNER.seed(seed, "x", 7) < 2**31
