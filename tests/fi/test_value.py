"""A bit flip in a value or an array: what comes back, and what stays."""

import numpy as np
import pytest

from mavfi_cli.core.errors import FaultError, FaultSpecError, UnknownName
from mavfi_cli.fi.bits import NUMPY_TYPES, Field
from mavfi_cli.fi.fault import inject


@pytest.mark.parametrize("value", [5.0, 7, True, np.float32(2.5), np.int16(3), np.bool_(0)])
def test_a_scalar_keeps_its_type_and_twice_restores_it(value):
    struck = inject(value, seed=3)
    assert type(struck) is type(value)
    assert struck != value
    assert inject(struck, seed=3) == value


@pytest.mark.parametrize("dtype", NUMPY_TYPES)
def test_one_element_of_a_copy_of_an_array_changes(dtype):
    array = np.ones((4, 3), dtype)
    struck = inject(array, seed=2)
    assert (struck.shape, struck.dtype) == (array.shape, array.dtype)
    assert (struck != array).sum() == 1
    assert array.all()
    np.testing.assert_array_equal(inject(array, seed=2), struck)


def test_bits_and_fields_are_those_that_are_asked_for():
    assert inject(5.0, field="sign") == -5.0
    assert inject(5.0, field=Field.SIGN) == -5.0
    assert inject(8, exact_bits=[0, 3]) == 1
    changed = [
        np.float64(inject(1.0, bits=3, field="mantissa", seed=seed)).view(np.uint64)
        ^ np.float64(1.0).view(np.uint64)
        for seed in range(20)
    ]
    assert {int(mask).bit_count() for mask in changed} == {3}
    assert all(int(mask) < 2**52 for mask in changed)
    assert len(set(changed)) > 1


@pytest.mark.parametrize(
    ("value", "asked", "error"),
    [
        ("text", {}, FaultSpecError),
        (2**70, {}, FaultSpecError),
        (np.zeros(0), {}, FaultSpecError),
        (1, {"field": "exponent"}, FaultError),
        (1.0, {"bits": 2, "field": "sign"}, FaultError),
        (1.0, {"field": "exponnent"}, UnknownName),
        (1.0, {"exact_bits": [64]}, FaultError),
    ],
)
def test_what_cannot_be_flipped_is_a_clear_error(value, asked, error):
    with pytest.raises(error):
        inject(value, **asked)
