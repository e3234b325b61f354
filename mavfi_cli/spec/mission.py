"""Configuration of a mission: a frozen dataclass from which the flight can be repeated."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from mavfi_cli.autonomy import canonical_planner
from mavfi_cli.core.errors import ConfigError, UnknownName
from mavfi_cli.core.frames import norm
from mavfi_cli.core.types import KERNELS, Briefing, FloatArray, Stage
from mavfi_cli.spec.companion import CompanionConfig
from mavfi_cli.spec.detector import DetectorConfig
from mavfi_cli.spec.fault import FaultConfig, InstructionConfig
from mavfi_cli.spec.platform import PlatformProfile
from mavfi_cli.spec.stack import DEFAULT, Stack, load_stack

FIRMWARE = {"px4": "PX4_SITL", "ardupilot": "ARDUCOPTER_SITL"}
"""Real autopilots, and the environment variables that name their SITL binaries."""

OWN_AUTOPILOT = "ours"
_REPEATING = (OWN_AUTOPILOT, "ardupilot")  # autopilots whose flights repeat exactly
_LOSS_LIMIT_S = 5.0
_NEEDS_LINK = "needs --link, a link to a foreign autopilot"
_NOT_WITH_LINK = "cannot be combined with --link"
OF_THE_WORLD = (
    "world", "world_seed", "vehicle", "start", "camera_columns", "camera_rows",
)  # fmt: skip
"""Fields of `MissionConfig` that configure the world and its simulation."""

OF_THE_COMPANION = (
    "planner", "platform", "stack", "a_max_mps2", "map_resolution_m", "map_range_m",
    "node_restart_s", "node_watchdog_s",
)  # fmt: skip
"""Fields of `MissionConfig` that configure mavfi's own companion."""

_OF_LOST_NODES: Mapping[str, Any] = {"node_restart_s": 1.0, "node_watchdog_s": 5.0}
NOT_OF_GOLDEN: Mapping[str, Any] = {
    "fault": None, "instruction": None, "detector": None, "isolate": (), **_OF_LOST_NODES,
}  # fmt: skip
"""Fields that a golden mission does not use, with the values to which it resets them."""

LOWEST_M, HIGHEST_M = 2.0, 10.0  # flight levels above home; MAVBench plans between 1 and 10 m
REMOTE_M = 1.0e7  # beyond this, float64 is coarser than a nanometre
FARTHEST_M = 200.0  # maximum goal distance; limits the memory of the obstacle grid
MARGIN_M = 30.0  # flight bounds around home and goal without a known world
_MOUNT_FLU_M = (0.1, 0.0, 0.0)  # default of the stand-alone camera

Vector3 = tuple[float, float, float]
LIMITS = {  # minimum and maximum of each number
    "takeoff_height_m": (1.0, 50.0),
    "v_max_mps": (0.1, 12.0),
    "a_max_mps2": (0.5, 8.0),
    "goal_tolerance_m": (0.1, 50.0),
    "time_limit_s": (1.0, 86400.0),
    "map_resolution_m": (0.05, 1.0),
    "map_range_m": (2.0, 25.0),
    "node_restart_s": (0.0, 3600.0),
    "node_watchdog_s": (0.1, 3600.0),
    "camera_rate_hz": (0.1, 50.0),
    "loss_limit_s": (0.1, 3600.0),
    "seed": (0, 2**31 - 1),
    "world_seed": (0, 2**31 - 1),
    "camera_columns": (4, 1024),
    "camera_rows": (4, 1024),
    "speed": (0.01, 100.0),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class MissionConfig:
    """The configuration of one mission. Positions are in the world frame (ENU), in metres.

    Attributes:
        world: Name of a world, or path of a TOML file of boxes.
        planner: Name of the planner, stored in its canonical form.
        seed: Root seed of the mission, from which world, planner, latency and sensor streams
            derive.
        platform: Compute platform, or path of a TOML file; it gives the kernels their latencies.
        stack: Stack of the companion, as for `load_stack`.
        vehicle: Simulated vehicle, or path of a TOML file.
        start, goal: Positions; None selects the world's.
        takeoff_height_m: Height at which the companion takes over.
        v_max_mps, a_max_mps2: Limits of planned trajectories.
        goal_tolerance_m: Distance from the goal that counts as reached; None selects the stack's.
        time_limit_s: Simulated time from take-off after which the mission ends as `timeout`.
        map_resolution_m, map_range_m: Edge of a voxel; length of the longest ray in the map.
        camera_columns, camera_rows, camera_rate_hz: Size and rate of the depth images.
        world_seed: Seed of a generated world, or of start and goal in a scene; None for `seed`.
        link: MAVLink endpoint of a foreign autopilot; None starts the simulated vehicle.
        eyes: Start the world's depth camera and referee alongside a foreign autopilot.
        origin: With `eyes`, position of the foreign autopilot's local origin in the world; None for
            the world's start.
        autopilot: Autopilot of the simulated vehicle: `ours` or real firmware.
        firmware: SITL binary of a real autopilot; None takes it from the environment variable.
        key_file: File with the signing passphrase of the link; None for an unsigned link.
        loss_limit_s: Time without a new state of a foreign autopilot after which the link counts as
            lost, on its clock and on the wall clock, s.
        realtime: Run the simulated vehicle at wall-clock speed.
        land: Land and disarm at the goal.
        fault: Source-level fault to inject; None for a golden run.
        instruction: Instruction-level fault to inject; None for a golden run.
        detector: Detector that checks messages before they take effect; None for no detector.
        node_restart_s: Simulated time from the death of a node to its restart, s; 3600 means never,
            which a campaign's file may also write as "never".
        node_watchdog_s: Simulated time after which a busy node counts as hung and is killed, s.
        isolate: Nodes that run in processes of their own; does not change the record.
        companion: TOML file or command line of a user's companion, which flies in place of mavfi's.
        speed: Pace of the simulated vehicle with a user's companion, as a multiple of real time.
    """

    world: str = "dense"
    seed: int = 3
    planner: str = "rrtstar"
    platform: str = "x86"
    stack: str = DEFAULT
    vehicle: str = "solo"
    start: Vector3 | None = None
    goal: Vector3 | None = None
    takeoff_height_m: float = 5.0
    v_max_mps: float = 3.0
    a_max_mps2: float = 5.0
    goal_tolerance_m: float | None = None
    time_limit_s: float = 300.0
    map_resolution_m: float = 0.2
    map_range_m: float = 7.0
    camera_columns: int = 64
    camera_rows: int = 48
    camera_rate_hz: float = 10.0
    realtime: bool = False
    link: str | None = None
    eyes: bool = False
    origin: Vector3 | None = None
    autopilot: str = OWN_AUTOPILOT
    firmware: str | None = None
    key_file: str | None = None
    loss_limit_s: float = _LOSS_LIMIT_S
    land: bool = False
    node_restart_s: float = _OF_LOST_NODES["node_restart_s"]
    node_watchdog_s: float = _OF_LOST_NODES["node_watchdog_s"]
    fault: FaultConfig | None = None
    instruction: InstructionConfig | None = None
    detector: DetectorConfig | None = None
    isolate: tuple[str, ...] = ()
    world_seed: int | None = None
    companion: str | None = None
    speed: float = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "planner", canonical_planner(self.planner))
        ConfigError.check_limits(self, LIMITS)
        for name in ("start", "goal", "origin"):
            place = getattr(self, name) or ()
            if not all(map(math.isfinite, place)):
                raise ConfigError(f"must be three finite numbers, got {place}", key=name)
            if not all(abs(coordinate) <= REMOTE_M for coordinate in place):
                raise ConfigError(
                    f"must be within {REMOTE_M:g} m of the origin, got {place}", key=name
                )
        if self.fault is not None and self.instruction is not None:
            raise ConfigError(
                "cannot be combined with a state fault: a mission can have only one fault",
                key="instruction",
            )
        if self.fault is not None:
            self.fault.check_within(self.time_limit_s)
        if self.instruction is not None and self.companion is not None:
            self.instruction.moment().check_within(self.time_limit_s)
        self._check_companion()
        self._check_link()
        self._check_platform()
        self._check_autopilot()
        for node in self.isolate:
            if node not in KERNELS:
                raise UnknownName("node", node, KERNELS)

    def _check_link(self) -> None:
        if self.link is None:
            for name in ("eyes", "key_file", "loss_limit_s"):
                if getattr(self, name) not in (False, None, _LOSS_LIMIT_S):
                    raise ConfigError(_NEEDS_LINK, key=name)
        if self.origin is not None and not self.eyes:
            raise ConfigError(
                "needs --eyes, which starts the world that the origin refers to", key="origin"
            )
        if self.link is None:
            return
        if self.realtime:
            raise ConfigError(_NOT_WITH_LINK, key="realtime")
        if self.eyes:
            return
        if self.goal is None:
            raise ConfigError("needs --goal X,Y,Z (ENU, m) or --eyes", key="link")
        plain = MissionConfig(goal=self.goal)
        for name in OF_THE_WORLD:
            if getattr(self, name) != getattr(plain, name):
                raise ConfigError("has no effect with --link unless --eyes is given", key=name)

    def _check_companion(self) -> None:
        if self.companion is None:
            if self.speed != 1.0:
                raise ConfigError("needs --companion", key="speed")
            if self.fault is not None and self.fault.wire_target is not None:
                raise ConfigError("a fault in a MAVLink message needs --companion", key="inject")
            return
        for name in ("link", "realtime", "isolate", "land"):
            if getattr(self, name):
                raise ConfigError("cannot be combined with --companion", key=name)
        if self.detector is not None:
            usual = DetectorConfig(name=self.detector.name)
            for name in ("alarms_max", "watch"):
                if getattr(self.detector, name) != getattr(usual, name):
                    raise ConfigError("has no effect on the gate of a user's companion", key=name)
            if set(self.detector.protect) <= {Stage.PERCEPTION.value}:
                raise ConfigError(
                    "must name planning (the vehicle's state) or control (the setpoint) for the "
                    "gate of a user's companion", key="protect",
                )  # fmt: skip
        plain = MissionConfig()
        for name in OF_THE_COMPANION:
            if getattr(self, name) != getattr(plain, name):
                raise ConfigError("has no effect on the flight of a user's companion", key=name)

    def _check_platform(self) -> None:
        if PlatformProfile.factor_of(self.platform) is None:
            return
        if not self.realtime and self.link is None:
            raise ConfigError(
                f"{self.platform} needs --realtime, because it measures kernel times in flight",
                key="platform",
            )
        if self.isolate or self.instruction is not None:
            raise ConfigError(
                f"{self.platform} cannot be combined with isolate or --level instruction, because "
                "it measures the kernels in the companion's own process",
                key="platform",
            )

    def _check_autopilot(self) -> None:
        if self.autopilot not in (OWN_AUTOPILOT, *FIRMWARE):
            raise UnknownName("autopilot", self.autopilot, (OWN_AUTOPILOT, *FIRMWARE))
        if self.autopilot == OWN_AUTOPILOT:
            return
        if self.link is not None:
            raise ConfigError(_NOT_WITH_LINK, key="autopilot")
        repeats = self.autopilot in _REPEATING and not self.realtime
        if self.instruction is not None and self.companion is None and not repeats:
            paced = " with --realtime" if self.realtime else ""
            raise ConfigError(
                f"{self.autopilot}{paced} cannot be combined with --level instruction, because its "
                "flights do not repeat exactly",
                key="autopilot",
            )

    def to_dict(self) -> dict[str, Any]:
        """Return the configuration as a dict for the record of the run.

        Settings of the host, and settings that this kind of flight does not have, are omitted. For
        a foreign autopilot without `eyes`, the settings of the world are None.
        """
        values = asdict(self)
        del values["isolate"], values["key_file"]
        if self.instruction is not None:
            values["instruction"] = self.instruction.as_dict()
        if self.autopilot == OWN_AUTOPILOT:
            del values["autopilot"], values["firmware"]
        if self.link is None:
            del values["loss_limit_s"], values["eyes"], values["origin"]
        elif not self.eyes:  # the flight had no world
            values.update(dict.fromkeys(OF_THE_WORLD))
        if self.companion is None:
            del values["companion"], values["speed"]
        return values

    @property
    def paced_s(self) -> float:
        """Longest wall-clock time of a flight that keeps pace with the wall clock, s; else 0."""
        paced = self.companion is not None or self.realtime
        return self.time_limit_s / self.speed if paced else 0.0

    @property
    def golden(self) -> MissionConfig:
        """The golden mission: the same mission without a fault and without a detector."""
        return replace(self, **NOT_OF_GOLDEN)

    @property
    def shared_flight(self) -> MissionConfig | None:
        """The fault-free mission from whose flight this mission can be forked, or None.

        It has the default settings for lost nodes, because they do not matter without a fault. It
        is None if other processes or the wall clock affect this mission's flight.
        """
        alone = (
            self.isolate
            or self.realtime
            or self.link is not None
            or self.companion is not None
            or self.autopilot != OWN_AUTOPILOT
        )
        if alone:
            return None
        return replace(self, fault=None, instruction=None, **_OF_LOST_NODES)

    @property
    def seed_of_world(self) -> int:
        """Seed of the world: `world_seed`, or `seed` if that is None."""
        return self.seed if self.world_seed is None else self.world_seed

    @property
    def files(self) -> tuple[str, ...]:
        """Paths of the user's files on whose contents the mission depends."""
        model = None if self.detector is None else self.detector.model
        stack = self.stack.partition(":")[0]  # without the differences of a variant
        named = (self.world, self.platform, stack, self.vehicle)
        files = tuple(name for name in named if name.endswith(".toml"))
        files += tuple(name for name in (model, self.firmware) if name)
        if self.companion is None:
            return files
        own = (self.companion,) if CompanionConfig.is_file(self.companion) else ()
        return files + own + CompanionConfig.load(self.companion, starts=False).files

    def loaded_stack(self) -> Stack:
        """Load the mission's stack. The mission's goal tolerance, if set, replaces the stack's.

        Raises the errors of `load_stack`.
        """
        stack, own_m = load_stack(self.stack), self.goal_tolerance_m
        return stack if own_m is None else replace(stack, goal_tolerance_m=own_m)

    def with_firmware(self) -> MissionConfig:
        """Return the mission with `firmware` set to the SITL binary of its real autopilot.

        A mission with mavfi's own autopilot is returned unchanged.

        Raises:
            ConfigError: Neither the mission nor the environment names the binary.
        """
        if self.autopilot == OWN_AUTOPILOT:
            return self
        variable = FIRMWARE[self.autopilot]
        path = self.firmware or os.environ.get(variable)
        if not path:
            raise ConfigError(
                f"{self.autopilot} needs its SITL binary: --firmware PATH, or {variable} in the "
                "environment",
                key="firmware",
            )
        return replace(self, firmware=path)

    @property
    def programs(self) -> tuple[str, ...]:
        """Programs that the mission names and executes: the firmware and the user's companion."""
        return tuple(name for name in (self.firmware, self.companion) if name is not None)

    def require_programs(self, *known: str | None) -> None:
        """Reject a recorded mission that would execute a program not listed in `known`.

        Flying a record executes the programs that it names, and a record is untrusted. Firmware
        named by the environment variable counts as known.

        Raises:
            ConfigError: The mission names a program that is not known.
        """
        variable = FIRMWARE.get(self.autopilot, "")
        trusted = {os.path.realpath(name) for name in known if name}
        installed = {os.path.realpath(path) for path in [os.environ.get(variable)] if path}
        for key, name, also, where in (
            ("firmware", self.firmware, installed, f" or in {variable or 'the environment'}"),
            ("companion", self.companion, set[str](), ""),
        ):
            if name is not None and os.path.realpath(name) not in trusted | also:
                raise ConfigError(
                    f"the record would execute the program {name}; to allow it, name it with "
                    f"--{key}{where}",
                    key=key,
                )

    def briefing(self, start_enu_m: FloatArray) -> Briefing:
        """Build the briefing for a foreign autopilot in an unknown world.

        `start_enu_m` (3,) is the position of the vehicle before take-off.
        """
        goal = np.array(self.goal)
        low, high = np.minimum(goal, start_enu_m), np.maximum(goal, start_enu_m)
        bounds = np.concatenate([low - MARGIN_M, high + MARGIN_M])
        bounds[[2, 5]] = LOWEST_M, HIGHEST_M
        return Briefing(
            start_enu_m=start_enu_m,
            goal_enu_m=goal,
            bounds_enu_m=bounds,
            camera_offset_flu_m=np.array(_MOUNT_FLU_M),
        )

    def require_flyable(self, briefing: Briefing, tolerance_m: float) -> None:
        """Reject a goal that is too near, too far, or outside the flight levels.

        Args:
            tolerance_m: Distance from the goal that counts as reached.

        Raises:
            ConfigError: The goal is invalid.
        """
        start, goal = briefing.start_enu_m, briefing.goal_enu_m
        takeoff = np.add(start, (0.0, 0.0, self.takeoff_height_m))
        problem = ""
        if norm(goal - takeoff) <= tolerance_m:
            problem = f"is within {tolerance_m:g} m of the take-off point"
        elif not LOWEST_M <= float(goal[2]) <= HIGHEST_M:
            problem = f"is {goal[2]:g} m high; it must be {LOWEST_M:g} to {HIGHEST_M:g} m high"
        elif norm(goal[:2] - start[:2]) > FARTHEST_M:
            problem = f"is farther than {FARTHEST_M:g} m from the start"
        if problem:
            raise ConfigError(f"the goal {problem}", key="goal")
