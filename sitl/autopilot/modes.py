"""Flight modes of PX4 and their codes in HEARTBEAT and DO_SET_MODE.

custom_mode = main << 16 | sub << 24 (PX4's px4_custom_mode.h, confirmed with v1.17).
"""

from __future__ import annotations

from enum import Enum

_CUSTOM_MODE_ENABLED = 0x01
_AUTO_ENABLED = 0x04
_GUIDED_ENABLED = 0x08
_STABILIZE_ENABLED = 0x10
_MANUAL_INPUT_ENABLED = 0x40
SAFETY_ARMED = 0x80


class FlightMode(Enum):
    """A flight mode: PX4's main mode, its sub mode, and the name that PX4's texts use."""

    MANUAL = (1, 0, "Manual")
    POSCTL = (3, 0, "Position")
    TAKEOFF = (4, 2, "Takeoff")
    LOITER = (4, 3, "Hold")
    RTL = (4, 5, "Return")
    LAND = (4, 6, "Land")
    OFFBOARD = (6, 0, "Offboard")

    def __init__(self, main: int, sub: int, label: str) -> None:
        self.main = main
        self.sub = sub
        self.label = label
        self.custom_mode = main << 16 | sub << 24

    @property
    def is_auto(self) -> bool:
        """True if the autopilot flies by itself in this mode."""
        return self.main == 4


_BY_NUMBERS = {(mode.main, mode.sub): mode for mode in FlightMode}


def mode_from_numbers(main: int, sub: int) -> FlightMode | None:
    """Return the mode of param2 and param3 of a DO_SET_MODE; None if there is none.

    The sub mode is used for AUTO only. AUTO without a sub mode is LOITER.
    """
    if main == 4:
        return _BY_NUMBERS.get((4, sub or FlightMode.LOITER.sub))
    return _BY_NUMBERS.get((main, 0))


def mode_from_custom(custom_mode: int) -> FlightMode | None:
    """Return the mode of a SET_MODE's custom_mode; None if there is none."""
    return mode_from_numbers(custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF)


def base_mode(mode: FlightMode, *, armed: bool) -> int:
    """Return HEARTBEAT.base_mode of a mode as in PX4 v1.17."""
    flags = _CUSTOM_MODE_ENABLED | (SAFETY_ARMED if armed else 0)
    if mode.is_auto:
        return flags | _AUTO_ENABLED | _GUIDED_ENABLED | _STABILIZE_ENABLED
    if mode is FlightMode.OFFBOARD:
        return flags | _STABILIZE_ENABLED
    stabilized = _STABILIZE_ENABLED if mode is FlightMode.POSCTL else 0
    return flags | _MANUAL_INPUT_ENABLED | stabilized
