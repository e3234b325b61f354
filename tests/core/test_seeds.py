from hypothesis import given
from hypothesis import strategies as st

from mavfi_cli.core.seeds import Stream, derive, generator

seeds = st.integers(0, 2**31 - 1)


@given(seeds)
def test_a_stream_repeats(seed):
    draws = [generator(seed, Stream.PLANNER, 3).integers(2**62, size=4).tolist() for _ in range(2)]
    assert draws[0] == draws[1]
    assert derive(seed, Stream.WORLD) == derive(seed, Stream.WORLD)


@given(seeds)
def test_streams_are_separate(seed):
    draws = {tuple(generator(seed, stream).integers(2**62, size=2)) for stream in Stream}
    draws |= {tuple(generator(seed, Stream.LATENCY, d).integers(2**62, size=2)) for d in ("a", "b")}
    assert len(draws) == len(Stream) + 2


@given(seeds)
def test_a_derived_seed_fits_what_libraries_take(seed):
    assert 1 <= derive(seed, Stream.PLANNER, "x", 7) < 2**31
