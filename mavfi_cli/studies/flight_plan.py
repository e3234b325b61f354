"""The missions of `mavfi vpm --fly`, and each row of the model as vehicle, platform and limits.

The simulated vehicle and platform are TOML files that a mission names by path. Their names contain
a digest of their contents, so that equal names mean equal flights.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from mavfi_cli.analysis.overhead import TIMES
from mavfi_cli.campaigns.missions import PlannedMission
from mavfi_cli.companion.pipeline import BRAKE_SHARE
from mavfi_cli.core.errors import RecordError
from mavfi_cli.core.files import write_text
from mavfi_cli.spec.detector import DetectorConfig
from mavfi_cli.spec.mission import LIMITS, MissionConfig
from mavfi_cli.spec.platform import PlatformProfile
from mavfi_cli.spec.stack import DEFAULT
from mavfi_cli.studies.train import WORLDS as TRAINING_WORLDS
from mavfi_cli.vpm.model import DETECTORS, ModelInputs, Scheme, outcome, safe_velocity_mps
from mavfi_cli.vpm.report import Choices
from mavfi_cli.vpm.vehicle import ModelVehicle

WORLDS = ("sparse", "dense")
# Parts of the model that the simulation omits; printed with every report of flights.
NOT_SCALED = (
    "size, propellers and drag are those of the simulated vehicle; boards weigh, but have no "
    "size: inertia and drag do not grow with them",
    "the model's acceleration is pull / mass - g; here it is the companion's limit, of which "
    f"planning uses {100.0 * BRAKE_SHARE:g} % to speed up and to brake",
    "the simulated companion plans with 90 % of the safe velocity, flies round obstacles, stops to "
    "plan, and speeds up and slows down; the model flies straight at one velocity",
    "flights begin at take-off height and end within the goal's tolerance; climbing there is not "
    "counted, as in the model; a turn before departure, where the stack has one, is counted",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightPlan:
    """Plan of the flights of a vehicle with a scheme.

    Attributes:
        mission: configuration without world and seed.
        files: TOML files of the mission, by path.
        braking_velocity_mps: safe velocity with the deceleration that the companion assumes.
        rotors_w: electrical hover power with all boards, by the model.
        boards_w: power of all boards.
        cut: values of the model that exceed the mission's limits, in words.
    """

    scheme: Scheme
    mission: MissionConfig
    files: Mapping[Path, str]
    braking_velocity_mps: float
    rotors_w: float
    boards_w: float
    cut: tuple[str, ...] = field(default=())


@dataclass(frozen=True, slots=True, kw_only=True)
class RedundancyPlan:
    """Plan of the flights of all vehicles and schemes.

    Attributes:
        missions: number per scheme and world.
        folder: folder of flights and pictures; recorded missions are not flown again.
        models: folder of the detectors' models; None takes the shipped ones.
        train: flights of each training world to which detectors are fitted for each vehicle; 0
            fits none.
        stack: stack of all flights.
    """

    vehicles: Sequence[ModelVehicle]
    choices: Choices
    worlds: tuple[str, ...] = WORLDS
    missions: int
    first_seed: int
    folder: Path
    models: Path | None = None
    train: int = 0
    stack: str = DEFAULT

    @property
    def models_told(self) -> str:
        """Origin of the detectors' models."""
        if self.train:
            return (
                f"fitted for each vehicle to {self.train} error-free flights in each of "
                f"{', '.join(TRAINING_WORLDS)} at its safe velocity"
            )
        if self.models is not None:
            return f"of {self.models}"
        return "the shipped ones, fitted to flights of the Solo at 3 m/s"

    def list_of(self, flown: Mapping[tuple[str, str], FlightPlan]) -> list[PlannedMission]:
        """The list mission by mission, so that pairs are complete if it is cut off."""
        seeds = range(self.first_seed, self.first_seed + self.missions)
        return [
            PlannedMission(
                config=replace(plan.mission, world=world, seed=seed),
                labels={"group": vehicle, "arm": scheme, "world": world},
                pair=f"{world}/{seed}",
            )
            for seed in seeds
            for world in self.worlds
            for (vehicle, scheme), plan in flown.items()
        ]


def flight_plan(
    setting: ModelInputs,
    scheme: Scheme,
    platform: PlatformProfile,
    chain_s: float,
    folder: Path,
    models: Path | None = None,
    stack: str = DEFAULT,
) -> FlightPlan:
    """The mission that flies a scheme at the model's safe velocity.

    Args:
        platform: platform whose latencies are scaled to the model's response time.
        chain_s: response time of that platform in the model.
        folder: absolute path of the folder for the files.
        models: folder of model files NAME.json; None takes the shipped ones.

    Raises:
        CannotLift: the rotors cannot lift this many boards.
        ConfigError: the model's numbers are not valid for a mission.
    """
    flown = outcome(setting, scheme)
    boards_w = scheme.copies * setting.board.power_w
    velocity_mps, cut_v = _within("v_max_mps", flown.velocity_mps, "velocity", "m/s")
    accel_mps2, cut_a = _within("a_max_mps2", flown.acceleration_mps2, "acceleration", "m/s²")
    range_m, cut_r = _within("map_range_m", setting.range_m, "sensing range", "m")
    rate_hz, cut_f = _within("camera_rate_hz", setting.vehicle.sensor_hz, "sensor rate", "Hz")
    stem = f"{_safe(setting.vehicle.name)}-{scheme.name}"
    vehicle = _file(folder, stem, _vehicle_text(setting, scheme, accel_mps2))
    factor = setting.compute_s * (1.0 + scheme.overhead) / chain_s
    computer = _file(folder, f"{stem}-{_safe(platform.name)}", _platform_text(platform, factor))
    detector = None
    if scheme.name in DETECTORS:
        model = None if models is None else str(models.absolute() / f"{scheme.name}.json")
        detector = DetectorConfig(name=scheme.name, model=model)
    return FlightPlan(
        scheme=scheme,
        mission=MissionConfig(
            vehicle=str(vehicle[0]),
            platform=str(computer[0]),
            stack=stack,
            v_max_mps=velocity_mps,
            a_max_mps2=accel_mps2,
            map_range_m=range_m,
            camera_rate_hz=rate_hz,
            detector=detector,
        ),
        files=dict((vehicle, computer)),
        braking_velocity_mps=safe_velocity_mps(
            BRAKE_SHARE * accel_mps2, setting.response_s(scheme.overhead), setting.range_m
        ),
        rotors_w=flown.power_w - boards_w,
        boards_w=boards_w,
        cut=tuple(filter(None, (cut_v, cut_a, cut_r, cut_f))),
    )


def write_files(plan: FlightPlan) -> None:
    """Write the TOML files of the plan's missions.

    Raises:
        RecordError: a file cannot be written.
    """
    for path, text in plan.files.items():
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RecordError(f"{path.parent}: {error.strerror or error}") from None
        write_text(path, text)


def _vehicle_text(setting: ModelInputs, scheme: Scheme, acceleration_mps2: float) -> str:
    """TOML of the simulated equivalent of the model's vehicle, with a scheme's boards."""
    vehicle, boards = setting.vehicle, scheme.copies
    told = f"{vehicle.name} of the performance model with {boards} x {setting.board.name}"
    return "\n".join(
        [
            f"name = {_quoted(f'{vehicle.name}-{scheme.name}')}",
            f"description = {_quoted(told)}",
            f"base = {_quoted(vehicle.stand_in)}",
            f"mass_kg = {vehicle.mass_kg!r}",
            f"extra_payload_kg = {setting.carried_kg(boards)!r}  # boards and heat sinks",
            f"rotor_pull_n = {setting.pull_n!r}",
            f"acceleration_mps2 = {acceleration_mps2!r}",
            f"hover_power_w = {vehicle.hover_power_w!r}",
            f"battery_wh = {vehicle.battery_wh!r}",
            f"avionics_w = {boards * setting.board.power_w!r}",
            "",
        ]
    )


def _platform_text(platform: PlatformProfile, factor: float) -> str:
    """TOML of a platform whose latencies are those of another times a factor."""
    lines = [
        f"name = {_quoted(f'{platform.name}{TIMES}{factor:.6g}')}",
        f"cores = {platform.cores}",
        f"carried = {str(platform.carried).lower()}",
    ]
    for name, kernel in platform.kernels.items():
        lines += [
            f"[kernels.{name}]",
            f"latency_s = {factor * kernel.latency_s!r}",
            f"spread = {kernel.spread!r}",
            f"source = {_quoted(f'{platform.name}{TIMES}{factor:.6g}')}",
        ]
    return "\n".join([*lines, ""])


def _within(key: str, wanted: float, what: str, unit: str) -> tuple[float, str]:
    """The nearest value that a mission allows, and a message if it differs."""
    low, high = LIMITS[key]
    taken = min(max(wanted, low), high)
    told = f"{what} {taken:g} {unit} instead of {wanted:.4g} {unit}"
    return taken, "" if taken == wanted else told


def _file(folder: Path, stem: str, text: str) -> tuple[Path, str]:
    digest = hashlib.sha256(text.encode()).hexdigest()[:8]
    return folder / f"{stem}-{digest}.toml", text


def _safe(name: str) -> str:
    return "".join(c if c.isalnum() or c in "-_." else "-" for c in name) or "unnamed"


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c.isprintable() else " " for c in escaped) + '"'
