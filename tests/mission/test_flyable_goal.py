"""Goals that are no flight are refused before take-off, in one line."""

import numpy as np
import pytest

from mavfi_cli.companion.kernels import _next_int32
from mavfi_cli.core.errors import ConfigError
from mavfi_cli.core.types import Briefing
from mavfi_cli.spec.mission import FARTHEST_M, MissionConfig


def briefing(*goal: float) -> Briefing:
    return Briefing(
        start_enu_m=np.zeros(3),
        goal_enu_m=np.array(goal),
        bounds_enu_m=np.array([-50.0, -50.0, 2.0, 50.0, 50.0, 10.0]),
        camera_offset_flu_m=np.zeros(3),
    )


@pytest.mark.parametrize(
    ("goal", "said"),
    [
        ((0.0, 0.5, 5.0), "within 1 m"),
        ((20.0, 20.0, 15.0), "15 m high; .*2 to 10 m"),
        ((20.0, 20.0, 1.0), "1 m high"),
        ((900.0, 0.0, 5.0), "farther than 200 m"),
    ],
)
def test_a_goal_that_cannot_be_flown_is_refused(goal, said):
    with pytest.raises(ConfigError, match=said) as error:
        MissionConfig().require_flyable(briefing(*goal), 1.0)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("goal", [(0.0, 1.1, 5.0), (FARTHEST_M, 0.0, 5.0), (30.0, 40.0, 10.0)])
def test_a_goal_at_the_edge_is_flown(goal):
    MissionConfig().require_flyable(briefing(*goal), 1.0)


def test_a_sequence_number_at_its_end_wraps_as_an_int32_does():
    assert _next_int32(4) == 5
    assert _next_int32(2**31 - 1) == -(2**31)
    assert _next_int32(-1) == 0
