"""Laws of the bit operations, against numpy's view of the same bytes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavfi_cli.core.errors import FaultError
from mavfi_cli.fi import bits as b
from mavfi_cli.fi.bits import Field

KINDS = [
    b.FLOAT64,
    b.FLOAT32,
    b.INT16,
    b.INT32,
    b.INT64,
    b.BOOL,
    *(b.BitType.raw(n) for n in (1, 2, 4, 8, 16, 64)),
]
VALUES = {
    "float64": st.floats(),
    "float32": st.floats(width=32, allow_nan=False),
    **{f"int{w}": st.integers(-(2 ** (w - 1)), 2 ** (w - 1) - 1) for w in (8, 16, 32, 64)},
    **{f"uint{w}": st.integers(0, 2**w - 1) for w in (8, 16, 32, 64)},
    "bool": st.booleans(),
}
kinds = st.sampled_from(KINDS)
seeds = st.integers(0, 2**32 - 1)


@st.composite
def drawn_bits(draw):
    kind = draw(kinds)
    field = draw(st.sampled_from(list(kind.fields)))
    count = draw(st.integers(1, len(kind.field_bits(field))))
    chosen = kind.draw(np.random.default_rng(draw(seeds)), field=field, count=count)
    return kind, field, count, chosen


@given(drawn_bits())
def test_popcount_of_the_mask_is_n(drawn):
    kind, _, count, chosen = drawn
    assert kind.mask(chosen).bit_count() == count
    assert len(set(chosen)) == count


@given(drawn_bits())
def test_the_field_is_respected(drawn):
    kind, field, _, chosen = drawn
    assert set(chosen) <= set(kind.field_bits(field))
    assert b.bits_of(kind.mask(chosen)) == chosen


@pytest.mark.parametrize("kind", [b.FLOAT64, b.FLOAT32], ids=lambda kind: kind.name)
def test_fields_of_a_float_partition_its_bits(kind):
    parts = [kind.field_bits(f) for f in (Field.MANTISSA, Field.EXPONENT, Field.SIGN)]
    assert [bit for part in parts for bit in part] == list(range(kind.width))
    info = np.finfo(kind.name)
    assert (len(parts[0]), len(parts[1])) == (info.nmant, info.nexp)


@given(st.sampled_from([kind for kind in b.NUMPY_TYPES.values() if kind is not b.BOOL]), st.data())
def test_patterns_are_numpys(kind, data):
    value = data.draw(VALUES[kind.name])
    array = np.array([value], dtype=kind.name)
    expected = int(array.view(f"uint{kind.width}")[0])
    assert kind.pattern(value) == expected


@given(st.sampled_from(list(b.NUMPY_TYPES.values())), seeds, st.data())
def test_flip_of_a_value_changes_exactly_its_bit(kind, seed, data):
    value = data.draw(VALUES[kind.name])
    (bit,) = kind.draw(np.random.default_rng(seed))
    before = kind.pattern(value)
    flipped = kind.flip(value, (bit,))
    if kind is b.FLOAT32 and np.isnan(flipped):
        return  # a signalling NaN does not survive Python's binary64
    assert kind.pattern(flipped) == before ^ (1 << bit)
    assert kind.pattern(kind.flip(flipped, (bit,))) == before


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_the_sign_field_negates(value):
    (bit,) = b.FLOAT64.field_bits(Field.SIGN)
    assert b.FLOAT64.flip(value, (bit,)) == -value


@given(st.binary(min_size=1, max_size=64), st.data())
def test_bytes_flip_as_numpy_unpacks_them(data, draw):
    bit = draw.draw(st.integers(0, 8 * len(data) - 1))
    flipped = b.flip_bytes(data, (bit,))
    before = np.unpackbits(np.frombuffer(data, np.uint8), bitorder="little")
    after = np.unpackbits(np.frombuffer(flipped, np.uint8), bitorder="little")
    assert np.flatnonzero(before != after).tolist() == [bit]


def test_every_bit_of_a_field_is_drawn():
    rng = np.random.default_rng(1)
    seen = {b.FLOAT64.draw(rng, field=Field.EXPONENT)[0] for _ in range(600)}
    assert seen == set(range(52, 63))


@pytest.mark.parametrize(("bit", "kind"), [(64, b.FLOAT64), (-1, b.INT32), (1, b.BOOL)])
def test_a_bit_outside_the_width_is_refused_in_one_line(bit, kind):
    with pytest.raises(FaultError, match=rf"bit of {kind.name} must be .* got {bit}") as caught:
        kind.mask((bit,))
    assert "\n" not in str(caught.value)


def test_a_field_that_the_type_has_not_is_refused():
    with pytest.raises(FaultError, match=r"int32 .*'exponent'.* sign, any"):
        b.INT32.field_bits(Field.EXPONENT)
    with pytest.raises(FaultError, match="sign of at least 2 bits"):
        b.FLOAT64.draw(np.random.default_rng(0), field=Field.SIGN, count=2)
