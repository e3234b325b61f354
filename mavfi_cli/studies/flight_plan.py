"""Each row of the model as a mission with its vehicle, platform and limits.

The simulated vehicle and platform are TOML files that a mission names by path. Their names contain
a digest of their contents, so that equal names mean equal flights.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mavfi_cli.analysis.beside_model import SchemeLimits
from mavfi_cli.analysis.overhead import TIMES
from mavfi_cli.campaigns.specification_file import folder_name
from mavfi_cli.companion.pipeline import BRAKE_SHARE
from mavfi_cli.core.config import toml_text
from mavfi_cli.core.files import write_text, writing
from mavfi_cli.spec.detector import detector_with_model
from mavfi_cli.spec.mission import LIMITS, MissionConfig
from mavfi_cli.spec.platform import PlatformProfile
from mavfi_cli.spec.stack import DEFAULT
from mavfi_cli.vpm.model import DETECTORS, ModelInputs, Scheme, outcome, safe_velocity_mps


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightPlan:
    """Plan of the flights of a vehicle with a scheme.

    Attributes:
        mission: configuration without world and seed.
        files: TOML files of the mission, by path.
    """

    mission: MissionConfig
    files: Mapping[Path, str]
    limits: SchemeLimits

    def write(self) -> None:
        """Write the files.

        Raises:
            RecordError: a file cannot be written.
        """
        for path, text in self.files.items():
            with writing(path.parent):
                path.parent.mkdir(parents=True, exist_ok=True)
            write_text(path, text)


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
        ModelError: the folder lacks the detector's model.
    """
    flown = outcome(setting, scheme)
    boards_w = scheme.copies * setting.board.power_w
    velocity_mps, cut_v = _within("v_max_mps", flown.velocity_mps, "velocity", "m/s")
    accel_mps2, cut_a = _within("a_max_mps2", flown.acceleration_mps2, "acceleration", "m/s²")
    range_m, cut_r = _within("map_range_m", setting.range_m, "sensing range", "m")
    rate_hz, cut_f = _within("camera_rate_hz", setting.vehicle.sensor_hz, "sensor rate", "Hz")
    stem = folder_name(f"{setting.vehicle.name}-{scheme.name}")
    vehicle = _file(folder, stem, _vehicle(setting, scheme, accel_mps2))
    factor = setting.compute_s * (1.0 + scheme.overhead) / chain_s
    computer = _file(folder, folder_name(f"{stem}-{platform.name}"), _platform(platform, factor))
    watched = scheme.name in DETECTORS
    mission = MissionConfig(
        vehicle=str(vehicle[0]),
        platform=str(computer[0]),
        stack=stack,
        v_max_mps=velocity_mps,
        a_max_mps2=accel_mps2,
        map_range_m=range_m,
        camera_rate_hz=rate_hz,
        detector=detector_with_model(scheme.name, models) if watched else None,
    )
    limits = SchemeLimits(
        v_max_mps=velocity_mps,
        a_max_mps2=accel_mps2,
        braking_velocity_mps=safe_velocity_mps(
            BRAKE_SHARE * accel_mps2, setting.response_s(scheme.overhead), setting.range_m
        ),
        rotors_w=flown.power_w - boards_w,
        boards_w=boards_w,
        cut=tuple(filter(None, (cut_v, cut_a, cut_r, cut_f))),
    )
    return FlightPlan(mission=mission, files=dict((vehicle, computer)), limits=limits)


def _vehicle(setting: ModelInputs, scheme: Scheme, acceleration_mps2: float) -> dict[str, Any]:
    """The simulated equivalent of the model's vehicle, with a scheme's boards and heat sinks."""
    vehicle, board, boards = setting.vehicle, setting.board, scheme.copies
    return {
        "name": f"{vehicle.name}-{scheme.name}",
        "description": f"{vehicle.name} of the performance model with {boards} x {board.name}",
        "base": vehicle.stand_in,
        "mass_kg": vehicle.mass_kg,
        "extra_payload_kg": setting.carried_kg(boards),
        "rotor_pull_n": setting.pull_n,
        "acceleration_mps2": acceleration_mps2,
        "hover_power_w": vehicle.hover_power_w,
        "battery_wh": vehicle.battery_wh,
        "avionics_w": boards * board.power_w,
    }


def _platform(platform: PlatformProfile, factor: float) -> dict[str, Any]:
    """A platform whose latencies are those of another times a factor."""
    source = f"{platform.name}{TIMES}{factor:.6g}"
    kernels = {
        name: {"latency_s": factor * kernel.latency_s, "spread": kernel.spread, "source": source}
        for name, kernel in platform.kernels.items()
    }
    return {
        "name": source, "cores": platform.cores, "carried": platform.carried, "kernels": kernels,
    }  # fmt: skip


def _within(key: str, wanted: float, what: str, unit: str) -> tuple[float, str]:
    """The nearest value that a mission allows, and a message if it differs."""
    low, high = LIMITS[key]
    taken = min(max(wanted, low), high)
    told = f"{what} {taken:g} {unit} instead of {wanted:.4g} {unit}"
    return taken, "" if taken == wanted else told


def _file(folder: Path, stem: str, values: Mapping[str, Any]) -> tuple[Path, str]:
    text = toml_text(values)
    digest = hashlib.sha256(text.encode()).hexdigest()[:8]
    return folder / f"{stem}-{digest}.toml", text
