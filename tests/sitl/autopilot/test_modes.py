import pytest

from sitl.autopilot.commander import FlightMode


# Seen on the wire of PX4 v1.17.
@pytest.mark.parametrize(
    ("mode", "custom"),
    [
        (FlightMode.LOITER, 50593792),
        (FlightMode.TAKEOFF, 33816576),
        (FlightMode.OFFBOARD, 393216),
        (FlightMode.RTL, 84148224),
        (FlightMode.LAND, 100925440),
        (FlightMode.POSCTL, 196608),
    ],
)
def test_custom_mode_is_px4s(mode, custom):
    assert mode.custom_mode == custom
    assert FlightMode.from_numbers(custom >> 16 & 0xFF, custom >> 24 & 0xFF) is mode


@pytest.mark.parametrize(
    ("mode", "armed", "expected"),
    [
        (FlightMode.LOITER, False, 0x1D),
        (FlightMode.LOITER, True, 0x9D),
        (FlightMode.OFFBOARD, True, 0x91),
        (FlightMode.OFFBOARD, False, 0x11),
    ],
)
def test_base_mode_is_px4s(mode, armed, expected):
    assert mode.base_mode(armed=armed) == expected


def test_auto_without_sub_mode_is_loiter():
    assert FlightMode.from_numbers(4, 0) is FlightMode.LOITER


@pytest.mark.parametrize("numbers", [(0, 0), (77, 0), (4, 99), (255, 255)])
def test_unknown_modes_are_none(numbers):
    assert FlightMode.from_numbers(*numbers) is None
