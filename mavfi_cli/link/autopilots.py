"""Differences between autopilots: mode numbers and take-off procedure.

Sources: PX4 px4_custom_mode.h (main mode in bits 16..23, sub mode in bits 24..31) and ArduCopter's
mode numbers; both confirmed with messages of PX4 1.17 and ArduCopter 4.5.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from mavfi_cli.link.codec import dialect


@dataclass(frozen=True, slots=True, kw_only=True)
class AutopilotProfile:
    """Modes and command conventions of one autopilot."""

    name: str
    modes: dict[str, int]  # mode name -> HEARTBEAT.custom_mode
    offboard_mode: str  # mode in which it follows our setpoints
    land_mode: str
    arming_modes: tuple[str, ...]  # modes that allow arming; the session requests the first
    takeoff_amsl: bool  # NAV_TAKEOFF altitude is above sea level instead of above home
    unused: float  # value of an unused command parameter
    early_setpoints: bool  # requires setpoints before the mode; False: they would abort take-off

    def mode_name(self, custom_mode: int) -> str:
        """Return the name of a HEARTBEAT.custom_mode, or "mode N" if it is unknown."""
        for name, number in self.modes.items():
            if number == custom_mode:
                return name
        return f"mode {custom_mode}"

    def mode_parameters(self, name: str) -> tuple[float, float]:
        """Return parameters 2 and 3 of MAV_CMD_DO_SET_MODE for a mode of `modes`."""
        number = self.modes[name]
        if self is PX4:
            return float(number >> 16 & 0xFF), float(number >> 24)
        return float(number), 0.0


def _px4(main: int, sub: int = 0) -> int:
    return main << 16 | sub << 24


PX4 = AutopilotProfile(
    name="PX4",
    modes={
        "MANUAL": _px4(1),
        "ALTCTL": _px4(2),
        "POSCTL": _px4(3),
        "AUTO.READY": _px4(4, 1),
        "AUTO.TAKEOFF": _px4(4, 2),
        "AUTO.LOITER": _px4(4, 3),
        "AUTO.MISSION": _px4(4, 4),
        "AUTO.RTL": _px4(4, 5),
        "AUTO.LAND": _px4(4, 6),
        "ACRO": _px4(5),
        "OFFBOARD": _px4(6),
        "STABILIZED": _px4(7),
    },
    offboard_mode="OFFBOARD",
    land_mode="AUTO.LAND",
    arming_modes=("AUTO.LOITER", "AUTO.TAKEOFF", "POSCTL"),
    takeoff_amsl=True,
    unused=math.nan,
    early_setpoints=True,
)

ARDUCOPTER = AutopilotProfile(
    name="ArduCopter",
    modes={
        "STABILIZE": 0,
        "ACRO": 1,
        "ALT_HOLD": 2,
        "AUTO": 3,
        "GUIDED": 4,
        "LOITER": 5,
        "RTL": 6,
        "CIRCLE": 7,
        "LAND": 9,
        "BRAKE": 17,
        "SMART_RTL": 21,
    },
    offboard_mode="GUIDED",
    land_mode="LAND",
    arming_modes=("GUIDED",),
    takeoff_amsl=False,
    unused=0.0,
    early_setpoints=False,
)


def autopilot_of(mav_autopilot: int) -> AutopilotProfile:
    """Return the entry for a HEARTBEAT.autopilot. An unknown autopilot is treated as PX4."""
    return ARDUCOPTER if mav_autopilot == dialect.MAV_AUTOPILOT_ARDUPILOTMEGA else PX4
