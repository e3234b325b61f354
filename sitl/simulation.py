"""Advances vehicle, autopilot, camera and referee together, one control tick at a time."""

from __future__ import annotations

import math
import resource
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from mavfi_cli.core.errors import VehicleProcessError
from mavfi_cli.core.files import write_json
from mavfi_cli.core.frames import Vector, dot, enu_from_ned, flu_enu_from_frd_ned
from mavfi_cli.core.types import FlightTruth
from mavfi_cli.core.wall import WallClock
from sitl.autopilot import services
from sitl.autopilot.autopilot import Autopilot
from sitl.autopilot.telemetry import STEP_US, STEPS_A_TICK, TICK_US, Link
from sitl.camera.component import Camera
from sitl.firmware.autopilot import FirmwareAutopilot
from sitl.referee import Referee
from sitl.vehicle.profile import VehicleProfile
from sitl.vehicle.truth import Truth
from sitl.vehicle.vehicle import Quadrotor
from sitl.world import World

HOST_FILE = "host.json"  # wall time and memory, stored next to the truth but not part of it
_FARTHEST_M = 1e6
_FASTEST_RADPS = 1e4
_GROUND_M = 0.3  # maximum height of a fallen vehicle's centre
_STEP_S = STEP_US * 1e-6


class Simulation:
    """Simulates one vehicle in one world, with its autopilot, camera and referee.

    The same arguments and messages give the same flight. It begins at the world's start, facing the
    goal.

    Args:
        camera: The vehicle's depth camera, or None for a camera with default settings.
        autopilot: Real firmware that flies the vehicle, or None for our own autopilot.
        trusted: Ids of the MAVLink systems that may send commands. If empty, all systems may.
        logs: Whether to keep the true state at every tick, for `truth` and `save_truth`.
    """

    awaits_setpoints = True  # in lockstep, every tick waits for the companion's setpoint

    def __init__(
        self,
        world: World,
        profile: VehicleProfile,
        *,
        camera: Camera | None = None,
        system_id: int = 1,
        step_s: float = _STEP_S,
        autopilot: FirmwareAutopilot | None = None,
        trusted: Sequence[int] = (),
        logs: bool = True,
    ) -> None:
        self._world, self._profile = world, profile
        self._system_id, self._trusted, self._logs = system_id, trusted, logs
        self._step_s, self._firmware_autopilot = step_s, autopilot
        self.camera = camera or Camera(
            world.boxes_enu_m, mount_offset_flu_m=profile.camera_mount_flu_m, system=system_id
        )
        self.wall = WallClock()  # host time spent in each part
        self.camera_due: list[Any] = []  # camera messages due at the newest tick
        self._set_up()

    def _set_up(self) -> None:
        world, profile = self._world, self._profile
        to_goal = world.goal_enu_m - world.start_enu_m
        yaw_rad = math.atan2(to_goal[1], to_goal[0])
        self.vehicle = Quadrotor(
            profile, position_enu_m=world.start_enu_m, yaw_enu_rad=yaw_rad, dt_s=self._step_s
        )
        self.autopilot: Autopilot | FirmwareAutopilot = self._firmware_autopilot or Autopilot(
            self.vehicle.truth, system_id=self._system_id, trusted=self._trusted
        )
        self.referee = Referee(
            world, profile.body_box_m, vehicle=profile.name, physics=profile.physics,
            logs=self._logs,
        )  # fmt: skip
        self.stamp_us = 0  # boot clock at the newest tick
        self._wreck: Truth | None = None
        self._look()

    def restart(self) -> None:
        """Begin again at the world's start, as after a reboot. Keep only the parameter values."""
        before = self.autopilot
        self._set_up()
        assert isinstance(before, Autopilot)
        assert isinstance(self.autopilot, Autopilot)
        self.autopilot.parameters.restore(before.parameters)

    def handle(self, message: Any, link: Link) -> None:
        """Pass a client's message to the autopilot."""
        assert isinstance(self.autopilot, Autopilot)
        services.handle(self.autopilot, message, link)

    def advance(self, between: Callable[[int], None] | None = None) -> None:
        """Simulate one control tick under the autopilot's command, then have the referee judge it.

        Args:
            between: Called after every physics step of the tick except the last, with the boot
                clock in microseconds.
        """
        self.wall.begin_tick()
        self._fly(between)
        self.stamp_us += TICK_US
        self._look()

    def _fly(self, between: Callable[[int], None] | None) -> None:
        autopilot, vehicle = self.autopilot, self.vehicle
        assert isinstance(autopilot, Autopilot)
        autopilot.fly()
        setpoint, motors_on = autopilot.snapshot.setpoint, autopilot.snapshot.motors_on
        count = STEPS_A_TICK if between is None else 1
        for step in range(count, STEPS_A_TICK + 1, count):
            if self._wreck is None:
                with self.wall.sample("physics"):
                    vehicle.step(setpoint, motors_on, count)
            if between is not None and step < STEPS_A_TICK:
                between(self.stamp_us + step * STEP_US)

    def begin(self, stopped: Callable[[], bool] = lambda: False) -> None:
        """Wait until the autopilot can fly, or until `stopped` returns True."""

    def close(self) -> None:
        """Release all resources outside this process. Safe to call more than once."""

    def truth(self) -> FlightTruth:
        """Return the referee's log and verdict, and this process's wall times and peak memory."""
        return FlightTruth(
            log=self.referee.log(),
            report=self.referee.report(self._energies_j()),
            stage_wall_s=self.wall.totals,
            memory_mb=_memory_mb(),
        )

    def save_truth(self, folder: Path) -> None:
        """Write the referee's log and verdict, and the host's wall times and memory, to a folder.

        Raises RecordError if a file cannot be written.
        """
        self.referee.save(folder, self._energies_j())
        host = {"stage_wall_s": self.wall.totals, "memory_mb": _memory_mb()}
        write_json(folder / HOST_FILE, host)

    def _energies_j(self) -> dict[str, float]:
        truth = self.vehicle.truth
        return {"regression": truth.energy_regression_j, "propeller": truth.energy_propeller_j}

    def _look(self) -> None:
        autopilot = self.autopilot
        truth = self._wreck or self.vehicle.truth
        position = enu_from_ned(truth.position_ned_m)
        quaternion = flu_enu_from_frd_ned(truth.quaternion_frd_ned)
        with self.wall.sample("referee"):
            self._judge(truth, position, quaternion)
        autopilot.observe(self.stamp_us, truth)
        with self.wall.sample("camera"):
            self.camera_due = self._photograph(position, quaternion)

    def _photograph(self, position_enu_m: Vector, quaternion_flu_enu: Vector) -> list[Any]:
        return self.camera.poll(self.stamp_us * 1e-6, position_enu_m, quaternion_flu_enu)

    def _judge(self, truth: Truth, position_enu_m: Vector, quaternion_flu_enu: Vector) -> None:
        """Have the referee judge the newest pose. After a collision, stop the motors permanently.

        Raises VehicleProcessError if position or rotation is too large for a flight.
        """
        commander, velocity = self.autopilot.commander, enu_from_ned(truth.velocity_ned_mps)
        collision = self.referee.observe(
            self.stamp_us * 1e-6, position_enu_m, quaternion_flu_enu, velocity,
            armed=commander.armed, on_ground=truth.on_ground,
            may_land=self.autopilot.may_touch_ground,
            power_regression_w=truth.power_regression_w, power_propeller_w=truth.power_propeller_w,
        )  # fmt: skip
        if collision is not None:
            commander.terminate(collision.text)
        place, rates = truth.position_ned_m, truth.rates_frd_radps
        is_down = truth.on_ground or place[2] > -_GROUND_M
        if self._wreck is None and commander.terminated and is_down:
            self._wreck = truth.wreck()
        if not (dot(place, place) < _FARTHEST_M**2 and dot(rates, rates) < _FASTEST_RADPS**2):
            raise VehicleProcessError(f"the physics diverged at {self.stamp_us * 1e-6:.2f} s")


def _memory_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
