"""Recent states of the vehicle, looked up by stamp."""

from __future__ import annotations

from bisect import bisect_left

import numpy as np

from mavfi_cli.core.frames import yaw_from_quaternion
from mavfi_cli.core.types import VehicleState

_REORDERED_MS = 1000  # older by less: a late packet; older by more: a restarted clock


class StateHistory:
    """The newest states in order of their stamps.

    Args:
        capacity: Minimum number of states to keep.
    """

    def __init__(self, capacity: int = 512) -> None:
        self._capacity = capacity
        self._stamps_ms: list[int] = []
        self._states: list[VehicleState] = []

    def add(self, state: VehicleState) -> bool:
        """Append a state. Return False if it is not newer than the newest."""
        stamp_ms = round(state.stamp_s * 1e3)
        if self._stamps_ms and stamp_ms <= self._stamps_ms[-1]:
            if stamp_ms > self._stamps_ms[-1] - _REORDERED_MS:
                return False
            self._stamps_ms.clear()
            self._states.clear()
        self._stamps_ms.append(stamp_ms)
        self._states.append(state)
        if len(self._states) >= 2 * self._capacity:
            del self._stamps_ms[: -self._capacity]
            del self._states[: -self._capacity]
        return True

    def at(self, stamp_s: float) -> VehicleState | None:
        """Return the state at a stamp, interpolated if needed; None outside the history."""
        stamp_ms = round(stamp_s * 1e3)
        index = bisect_left(self._stamps_ms, stamp_ms)
        if index == len(self._stamps_ms):
            return None
        if self._stamps_ms[index] == stamp_ms:
            return self._states[index]
        if index == 0:
            return None
        return _between(self._states[index - 1], self._states[index], stamp_s)


def _between(before: VehicleState, after: VehicleState, stamp_s: float) -> VehicleState:
    """Interpolate position and velocity linearly, the quaternion by normalised shortest lerp."""
    share = (stamp_s - before.stamp_s) / (after.stamp_s - before.stamp_s)
    sign = -1.0 if float(np.dot(before.quaternion, after.quaternion)) < 0.0 else 1.0
    quaternion = (1.0 - share) * before.quaternion + share * sign * after.quaternion
    norm = float(np.linalg.norm(quaternion))
    quaternion = quaternion / norm if norm > 0.0 else before.quaternion
    return VehicleState(
        stamp_s=stamp_s,
        position_enu_m=_mix(before.position_enu_m, after.position_enu_m, share),
        velocity_enu_mps=_mix(before.velocity_enu_mps, after.velocity_enu_mps, share),
        quaternion=quaternion,
        yaw_rad=yaw_from_quaternion(quaternion),
    )


def _mix(
    before: np.typing.NDArray[np.float64], after: np.typing.NDArray[np.float64], share: float
) -> np.typing.NDArray[np.float64]:
    mixed: np.typing.NDArray[np.float64] = (1.0 - share) * before + share * after
    return mixed
