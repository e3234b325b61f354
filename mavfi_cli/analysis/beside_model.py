"""Model and flights: each row of the model as missions, and its numbers beside the measured ones.

The simulated vehicle and platform are TOML files that a mission names by path. Their names contain
a digest of their contents, so that equal names mean equal flights.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from mavfi_cli.analysis.flights import changed, chosen, errors, flags, flown, known, numbers
from mavfi_cli.analysis.overhead import TIMES, ComputeOverhead
from mavfi_cli.analysis.pairs import paired
from mavfi_cli.campaigns.detector_plans import TRAINING_WORLDS, TrainingPlan
from mavfi_cli.campaigns.missions import PlannedMission
from mavfi_cli.campaigns.specification import require_named
from mavfi_cli.campaigns.specification_file import folder_name
from mavfi_cli.companion.pipeline import BRAKE_SHARE
from mavfi_cli.core.config import toml_text
from mavfi_cli.core.errors import ConfigError
from mavfi_cli.core.files import write_text, writing
from mavfi_cli.core.types import FloatArray
from mavfi_cli.spec.detector import DetectorConfig
from mavfi_cli.spec.mission import LIMITS, MissionConfig
from mavfi_cli.spec.platform import PlatformProfile
from mavfi_cli.spec.stack import DEFAULT
from mavfi_cli.stats.bootstrap import interval
from mavfi_cli.stats.shares import Interval, rate
from mavfi_cli.vpm.model import (
    DETECTORS,
    REFERENCE,
    SCHEMES,
    ModelInputs,
    ModelVehicle,
    Scheme,
    safe_velocity_mps,
)
from mavfi_cli.vpm.report import Choices

BASE = "none"  # reference of ratios: one board without protection
MODEL = {"velocity": "velocity_mps", "flight_time": "flight_time_s", "energy": "energy_j"}
PLACE = ("world", "seed")  # columns that identify a mission in all schemes
_BY_PLACE = [(name, "ascending") for name in PLACE]
Key = tuple[str, str]  # vehicle and scheme
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
WORLDS = ("sparse", "dense")


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightPlan:
    """Plan of the flights of a vehicle with a scheme.

    Attributes:
        mission: without world and seed.
        braking_velocity_mps: safe velocity with the deceleration that the companion assumes.
        rotors_w: electrical hover power with all boards.
        boards_w: power of all boards.
        cut: values of the model that exceed the limits of a mission, in words.
    """

    mission: MissionConfig
    files: Mapping[Path, str]
    braking_velocity_mps: float
    rotors_w: float
    boards_w: float
    cut: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
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
        flown, boards_w = setting.performance(scheme), scheme.copies * setting.board.power_w
        velocity, cut_v = _within("v_max_mps", flown["velocity_mps"], "velocity", "m/s")
        accel, cut_a = _within("a_max_mps2", flown["acceleration_mps2"], "acceleration", "m/s²")
        range_m, cut_r = _within("map_range_m", setting.range_m, "sensing range", "m")
        rate_hz, cut_f = _within("camera_rate_hz", setting.vehicle.sensor_hz, "sensor rate", "Hz")
        stem = folder_name(f"{setting.vehicle.name}-{scheme.name}")
        vehicle = _file(folder, stem, _vehicle(setting, scheme, accel))
        factor = setting.compute_s * (1.0 + scheme.overhead) / chain_s
        board = _file(folder, folder_name(f"{stem}-{platform.name}"), _platform(platform, factor))
        watched = scheme.name in DETECTORS
        mission = MissionConfig(
            vehicle=str(vehicle[0]),
            platform=str(board[0]),
            stack=stack,
            v_max_mps=velocity,
            a_max_mps2=accel,
            map_range_m=range_m,
            camera_rate_hz=rate_hz,
            detector=DetectorConfig.with_model(scheme.name, models) if watched else None,
        )
        response_s = setting.response_s(scheme.overhead)
        return cls(
            mission=mission,
            files=dict((vehicle, board)),
            braking_velocity_mps=safe_velocity_mps(
                BRAKE_SHARE * accel, response_s, setting.range_m
            ),
            rotors_w=flown["power_w"] - boards_w,
            boards_w=boards_w,
            cut=tuple(filter(None, (cut_v, cut_a, cut_r, cut_f))),
        )

    def write(self) -> None:
        """Write the files; a RecordError says why one cannot be written."""
        for path, text in self.files.items():
            with writing(path.parent):
                path.parent.mkdir(parents=True, exist_ok=True)
            write_text(path, text)

    def measured(self, name: str, flights: pa.Table) -> FloatArray:
        """A quantity of MODEL for each flight, (n,); NaN if a flight has none.

        Electrical energy of rotors and boards is shaft energy times the model's hover power over
        the simulated vehicle's, which is the same for any number of boards, plus the boards' power
        times the flight time.
        """
        if name == "velocity":
            return numbers(flights, "mean_speed_mps")
        time_s = numbers(flights, "flight_time_s")
        if name == "flight_time":
            return time_s
        shaft_j, hover_w = (numbers(flights, n) for n in ("energy_propeller_j", "hover_shaft_w"))
        return np.asarray(shaft_j * self.rotors_w / hover_w + self.boards_w * time_s)


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

    Raises:
        ConfigError, UnknownName: a world is missing or named twice, or the missions have seeds of
            training flights, which no flight may share in any world.
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

    def __post_init__(self) -> None:
        require_named("world", self.worlds)
        first = TrainingPlan().first_seed
        last = first + self.train * len(TRAINING_WORLDS) - 1
        if self.train and self.first_seed <= last and first < self.first_seed + self.missions:
            raise ConfigError(
                f"seeds {first} to {last} are for training: choose another --first-seed",
                key="first seed",
            )

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

    def list_of(self, flown: Mapping[Key, FlightPlan]) -> list[PlannedMission]:
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


# Beside the model ------------------------------------------------------------------------------


def _arm(table: pa.Table, key: Key) -> pa.Table:
    """The flights of a vehicle with a scheme."""
    return chosen(table, label_group=key[0], label_arm=key[1])


def side_by_side(
    told: Mapping[str, Any],
    plans: Mapping[Key, FlightPlan | str],
    flights: pa.Table,
    overheads: Mapping[str, ComputeOverhead],
) -> dict[str, Any]:
    """Unscaled properties, overheads, and one flat row per vehicle and scheme.

    Args:
        told: the model's report, with the overheads of the plans.
        plans: of each vehicle and scheme, or the reason why they cannot be flown.
        flights: of the missions of `RedundancyPlan.list_of`, as in `analysis.flights`.
        overheads: overheads measured in these flights, by detector.
    """
    return {
        "ratios_over": BASE,
        "paper_ratios_over": REFERENCE,
        "not_scaled": list(NOT_SCALED),
        "overheads": [
            {
                "detector": each.detector,
                "flights": each.flights,
                "alarms": each.alarms,
                "measured_percent": 100.0 * each.share,
                "checks_percent": 100.0 * each.checks_share,
                "checks_of_host_kernels_percent": 100.0 * each.checks_host_share,
                "paper_percent": 100.0 * SCHEMES[each.detector].overhead,
            }
            for each in overheads.values()
        ],
        "vehicles": [
            {
                "vehicle": one["vehicle"],
                "board": one["board"],
                "schemes": [
                    _scheme(row, plans[one["vehicle"], row["scheme"]], flights, one["vehicle"])
                    | _over(one, row, plans, flights)
                    for row in one["schemes"]
                ],
            }
            for one in told["vehicles"]
        ],
    }


def _scheme(
    row: Mapping[str, Any], plan: FlightPlan | str, flights: pa.Table, vehicle: str
) -> dict[str, Any]:
    told: dict[str, Any] = {
        "scheme": row["scheme"], "title": row["title"], "boards": row["boards"],
        "overhead_percent": row["overhead_percent"], "mass_kg": row["mass_kg"], "problem": None,
        "errors": [], "cut": [],
    }  # fmt: skip
    if isinstance(plan, str):
        return {**told, "problem": plan}
    mine = _arm(flights, (vehicle, row["scheme"]))
    return {
        **told,
        "v_max_mps": plan.mission.v_max_mps,
        "a_max_mps2": plan.mission.a_max_mps2,
        "braking_velocity_mps": plan.braking_velocity_mps,
        "cut": list(plan.cut),
        "errors": errors(mine, "{reason}"),
        **_success(flown(mine)),
        **_numbers(row, plan, flown(mine)),
    }


def _over(
    one: Mapping[str, Any],
    row: Mapping[str, Any],
    plans: Mapping[Key, FlightPlan | str],
    flights: pa.Table,
) -> dict[str, float]:
    """Ratios to one board without protection and, as in the paper, to detection and recovery."""
    rows = {each["scheme"]: each for each in one["schemes"]}
    told: dict[str, float] = {}
    for over, suffix, names in (
        (BASE, "", tuple(MODEL)),
        (REFERENCE, f"_over_{REFERENCE}", ("flight_time",)),
    ):
        keys = [(one["vehicle"], name) for name in (over, row["scheme"])]
        base, own = (plans[key] for key in keys)
        if isinstance(base, str) or isinstance(own, str):
            continue
        sides = [flown(_arm(flights, key)) for key in keys]
        pairs = paired(sides[1], sides[0], PLACE)[::-1]
        both = pa.array(np.logical_and(*(flags(each, "succeeded") for each in pairs)))
        first, second = (pair.filter(both).sort_by([*_BY_PLACE]) for pair in pairs)
        for name in names:
            model = row[MODEL[name]] / rows[over][MODEL[name]]
            before, after = base.measured(name, first), own.measured(name, second)
            found = changed(range(len(before)), before.tolist(), after.tolist())
            told |= _beside(f"{name}{suffix}", "_ratio", model, found)
            told[f"pairs{suffix}"] = found.count
    return told


def _success(flights: pa.Table) -> dict[str, Any]:
    success = rate(int(flags(flights, "succeeded").sum()), flights.num_rows)
    return {
        "missions": success.total,
        "outcomes": dict(Counter(flights["outcome"].to_pylist()).most_common()),
        "success_percent": 100.0 * success.share,
        "success_low_percent": 100.0 * success.low,
        "success_high_percent": 100.0 * success.high,
    }


def _numbers(row: Mapping[str, Any], plan: FlightPlan, flights: pa.Table) -> dict[str, Any]:
    """Absolute numbers of the successful flights, and the model's for the same missions."""
    won = chosen(flights, succeeded=True)
    straight_m = numbers(won, "straight_m")
    # The straight distance at the model's velocity.
    model_s = _mean(straight_m / row["velocity_mps"]).value
    energy_j, top = plan.measured("energy", won), _mean(numbers(won, "max_speed_mps"))
    path = _mean(numbers(won, "distance_m") / straight_m)
    return {
        **_beside("velocity", "_mps", row["velocity_mps"], _mean(numbers(won, "mean_speed_mps"))),
        **_beside("top_velocity", "_mps", row["velocity_mps"], top),
        **_beside("flight_time", "_s", model_s, _mean(numbers(won, "flight_time_s"))),
        **_beside("path", "_ratio", 1.0, path),
        **_beside("energy", "_j", row["power_w"] * model_s, _mean(energy_j)),
        **_beside("response", "_s", 1.0 / row["throughput_hz"],
                  _mean(numbers(won, "response_median_s"))),
        "flight_shaft_energy_j": _mean(numbers(won, "energy_propeller_j")).value,
        "flight_hover_shaft_w": _mean(numbers(won, "hover_shaft_w")).value,
        "flight_replans": _mean(numbers(won, "replans")).value,
        "flight_alarms": _mean(numbers(won, "alarm_count")).value,
    }  # fmt: skip


def _mean(values: FloatArray) -> Interval:
    return interval(known(values))


def _beside(name: str, unit: str, model: float, flight: Interval) -> dict[str, float]:
    """The model's number, the flights' number with its interval, and the difference."""
    of = "_ratio" if unit == "_ratio" else ""
    return {
        f"model_{name}{unit}": model,
        f"flight_{name}{unit}": flight.value,
        f"flight_{name}_low{unit}": flight.low,
        f"flight_{name}_high{unit}": flight.high,
        f"{name}{of}_difference_percent": 100.0 * (flight.value / model - 1.0),
    }
