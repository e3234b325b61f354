"""Parameters of the autopilot with PX4's names, types and defaults.

Parameters marked as acting affect the flight. The others exist because ground stations request
them. Limits apply to the values that the flight code uses, not to stored values, as PX4 stores any
value.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class Parameter:
    """One parameter: name of up to 16 characters, default and usable range."""

    name: str
    default: float | int  # the type of the default is the type of the parameter
    low: float = float("-inf")
    high: float = float("inf")
    read_only: bool = False

    @property
    def is_integer(self) -> bool:
        """True for an INT32, False for a REAL32."""
        return isinstance(self.default, int)


def _row(
    name: str, default: float, low: float = float("-inf"), high: float = float("inf")
) -> Parameter:
    return Parameter(name=name, default=default, low=low, high=high)


_ACTING = (
    _row("BAT_CRIT_THR", 0.07, 0.0, 0.5),
    _row("BAT_LOW_THR", 0.15, 0.0, 0.5),
    _row("COM_DISARM_LAND", 2.0, -1.0, 60.0),
    _row("COM_DISARM_PRFLT", 10.0, -1.0, 600.0),
    _row("COM_OBL_RC_ACT", 3, 0, 7),
    _row("COM_OF_LOSS_T", 1.0, 0.1, 60.0),
    _row("COM_RC_LOSS_T", 0.5, 0.1, 35.0),
    _row("COM_SPOOLUP_TIME", 1.0, 0.0, 30.0),
    _row("LNDMC_TRIG_TIME", 1.0, 0.1, 10.0),
    _row("MIS_TAKEOFF_ALT", 2.5, 0.5, 500.0),
    _row("MPC_ACC_HOR", 3.0, 0.5, 15.0),
    _row("MPC_LAND_ALT1", 10.0, 0.0, 1000.0),
    _row("MPC_LAND_ALT2", 5.0, 0.0, 1000.0),
    _row("MPC_LAND_SPEED", 0.7, 0.2, 5.0),
    _row("MPC_MAN_Y_MAX", 150.0, 1.0, 400.0),
    _row("MPC_TKO_RAMP_T", 3.0, 0.0, 5.0),
    _row("MPC_TKO_SPEED", 1.5, 0.5, 5.0),
    _row("MPC_VEL_MANUAL", 10.0, 0.5, 20.0),
    _row("MPC_XY_CRUISE", 5.0, 0.5, 20.0),
    _row("MPC_XY_VEL_MAX", 12.0, 0.1, 20.0),
    _row("MPC_Z_VEL_MAX_DN", 1.5, 0.2, 10.0),
    _row("MPC_Z_VEL_MAX_UP", 3.0, 0.2, 10.0),
    _row("MPC_Z_V_AUTO_DN", 1.5, 0.2, 10.0),
    _row("MPC_Z_V_AUTO_UP", 3.0, 0.2, 10.0),
    _row("NAV_ACC_RAD", 2.0, 0.1, 200.0),
    _row("NAV_MC_ALT_RAD", 0.8, 0.05, 200.0),
    _row("RTL_CONE_ANG", 45, 0, 90),
    _row("RTL_DESCEND_ALT", 30.0, 0.0, 1000.0),
    _row("RTL_MIN_DIST", 10.0, 0.5, 100.0),
    _row("RTL_RETURN_ALT", 60.0, 0.0, 1000.0),
)

_PRESENT = (
    _row("BAT1_CAPACITY", -1.0),
    _row("BAT1_N_CELLS", 4),
    _row("BAT_EMERGEN_THR", 0.05),
    _row("CAL_ACC0_ID", 1310988),
    _row("CAL_GYRO0_ID", 1310988),
    _row("CAL_MAG0_ID", 197388),
    _row("CBRK_SUPPLY_CHK", 0),
    _row("COM_FLTMODE1", -1),
    _row("COM_LOW_BAT_ACT", 0),
    _row("COM_RC_IN_MODE", 3),
    _row("EKF2_HGT_REF", 1),
    _row("GF_ACTION", 2),
    _row("MAV_PROTO_VER", 2),
    _row("MAV_TYPE", 2),
    _row("NAV_DLL_ACT", 0),
    _row("NAV_RCL_ACT", 2),
    _row("RTL_LAND_DELAY", 0.0),
    _row("RTL_TYPE", 0),
    _row("SYS_AUTOSTART", 10040),
    _row("SYS_AUTOCONFIG", 0),
    _row("SYS_HAS_BARO", 1),
    _row("SYS_HAS_GPS", 1),
    _row("SYS_HAS_MAG", 1),
)


def parameter_table(system_id: int) -> tuple[Parameter, ...]:
    """Return all parameters in index order, which is alphabetical."""
    fixed = (
        Parameter(name="MAV_COMP_ID", default=1, read_only=True),
        Parameter(name="MAV_SYS_ID", default=system_id, read_only=True),
    )
    return tuple(sorted((*_ACTING, *_PRESENT, *fixed), key=lambda row: row.name))
