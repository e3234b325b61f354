"""Land detector: on the ground, still, and without a climb setpoint for some time."""

from __future__ import annotations

from sitl.autopilot.truth import StateEstimate

_STILL_MPS = 0.5


class LandDetector:
    """Detects landing, with PX4's LNDMC_TRIG_TIME as hysteresis."""

    __slots__ = ("_settled_since_us", "landed")

    def __init__(self) -> None:
        self.landed = True
        self._settled_since_us: int | None = None

    def update(
        self, stamp_us: int, truth: StateEstimate, *, wants_up: bool, trigger_s: float
    ) -> bool:
        """Take the newest state. Return True if `landed` has changed."""
        if self.landed:
            self.landed = truth.on_ground
            self._settled_since_us = None
            return not self.landed
        if not truth.on_ground or wants_up or not _is_still(truth):
            self._settled_since_us = None
            return False
        if self._settled_since_us is None:
            self._settled_since_us = stamp_us
        self.landed = stamp_us - self._settled_since_us >= trigger_s * 1e6
        return self.landed


def _is_still(truth: StateEstimate) -> bool:
    velocity = truth.velocity_ned_mps
    return bool(abs(velocity[0]) + abs(velocity[1]) + abs(velocity[2]) < _STILL_MPS)
