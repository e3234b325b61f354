"""Vehicle, autopilot, camera and referee, advanced together one control tick at a time."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from mavfi_cli.core.frames import enu_from_ned, flu_enu_from_frd_ned
from sitl.autopilot.autopilot import Autopilot
from sitl.autopilot.streams import TICK_US
from sitl.camera.component import Camera
from sitl.referee import Referee
from sitl.vehicle.profile import VehicleProfile
from sitl.vehicle.vehicle import Vehicle
from sitl.world import World

STEPS_A_TICK = 5
_STEP_S = TICK_US * 1e-6 / STEPS_A_TICK


class Simulation:
    """One vehicle in one world; deterministic in its arguments and the messages handled.

    Args:
        world: where it flies; it starts at the world's start, facing the goal.
        profile: what flies.
        system_id: MAVLink system id.
        camera_columns: depth image width, pixels.
        camera_rows: depth image height, pixels.
        camera_rate_hz: frames a second where a client names no interval.

    Attributes:
        stamp_us: boot clock at the newest tick.
        camera_due: messages of the camera at the newest tick.
    """

    def __init__(
        self,
        world: World,
        profile: VehicleProfile,
        *,
        system_id: int = 1,
        camera_columns: int = 64,
        camera_rows: int = 48,
        camera_rate_hz: float = 10.0,
    ) -> None:
        to_goal = world.goal_enu_m - world.start_enu_m
        self.vehicle = Vehicle(
            profile,
            position_enu_m=world.start_enu_m,
            yaw_enu_rad=math.atan2(to_goal[1], to_goal[0]),
            dt_s=_STEP_S,
        )
        self.autopilot = Autopilot(self.vehicle.truth, system_id=system_id)
        self.camera = Camera(
            world.boxes_enu_m,
            columns=camera_columns,
            rows=camera_rows,
            mount_offset_flu_m=profile.camera_mount_flu_m,
            rate_hz=camera_rate_hz,
            system=system_id,
        )
        self.referee = Referee(world, profile.body_box_m, vehicle=profile.name)
        self.stamp_us = 0
        self.camera_due: list[Any] = []
        self._look()

    def advance(self) -> None:
        """Fly one control tick as the autopilot now wants it, then look at what came of it."""
        autopilot, vehicle = self.autopilot, self.vehicle
        autopilot.fly()
        setpoint, motors_on = autopilot.setpoint, autopilot.motors_on
        for _ in range(STEPS_A_TICK):
            vehicle.step(setpoint, motors_on)
        self.stamp_us += TICK_US
        self._look()

    def save_truth(self, folder: Path) -> None:
        """Write the referee's log and verdict; RecordError where that fails."""
        truth = self.vehicle.truth
        energies = {
            "regression": truth.energy_regression_j,
            "propeller": truth.energy_propeller_j,
        }
        self.referee.save(folder, energies)

    def _look(self) -> None:
        truth, autopilot = self.vehicle.truth, self.autopilot
        position = enu_from_ned(truth.position_ned_m)
        quaternion = flu_enu_from_frd_ned(truth.quaternion_frd_ned)
        stamp_s = self.stamp_us * 1e-6
        collision = self.referee.observe(
            stamp_s,
            position,
            quaternion,
            enu_from_ned(truth.velocity_ned_mps),
            armed=autopilot.commander.armed,
            on_ground=truth.on_ground,
            may_land=autopilot.may_touch_ground,
            power_regression_w=truth.power_regression_w,
            power_propeller_w=truth.power_propeller_w,
        )
        if collision is not None:
            autopilot.commander.terminate(collision.text)
        autopilot.observe(self.stamp_us, truth)
        self.camera_due = self.camera.poll(stamp_s, position, quaternion)
