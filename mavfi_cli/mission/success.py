"""Whether a flight of a user's companion meets its conditions of success."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from mavfi_cli.core.errors import ConfigError
from mavfi_cli.core.files import read_parquet
from mavfi_cli.core.frames import norm
from mavfi_cli.core.types import FloatArray, VehicleState
from mavfi_cli.mission.crew import Crew
from mavfi_cli.mission.run_folder import RunFolder
from mavfi_cli.spec.companion import SuccessConfig

_REST_MPS, _REST_S = 0.5, 1.0  # largest speed at rest, and how long it must last


@dataclass(frozen=True, slots=True)
class FlownPath:
    """The path of a flight: a polyline through positions of shape (n, 3) in ENU, in metres."""

    places: FloatArray

    @classmethod
    def of(cls, folder: Path) -> Self:
        """Read the path from a run folder.

        Raises:
            RecordError: The trace cannot be read.
            ConfigError: The trace has fewer than two positions, or one that is not finite.
        """
        trace = read_parquet(RunFolder(folder).trace, "golden trace")
        try:
            places = np.column_stack([trace[name].to_numpy() for name in ("x_m", "y_m", "z_m")])
        except KeyError:
            places = np.zeros((0, 3))
        if len(places) < 2:
            raise ConfigError("the golden trace has fewer than two positions", key="success.golden")
        if not np.isfinite(places).all():
            raise ConfigError(
                "the golden trace has a position that is not finite", key="success.golden"
            )
        return cls(places)

    def distance_m(self, place: FloatArray) -> float:
        """Return the distance of a point of shape (3,) from the path, in metres."""
        begin, along = self.places[:-1], np.diff(self.places, axis=0)
        lengths = np.maximum((along**2).sum(axis=1), 1e-12)
        shares = np.clip(((place - begin) * along).sum(axis=1) / lengths, 0.0, 1.0)
        return float(np.sqrt(((begin + shares[:, None] * along - place) ** 2).sum(axis=1)).min())

    def apart_m(self, other: FlownPath) -> float:
        """Return the largest distance of a position of either path from the other path, metres."""
        there, back = map(self.distance_m, other.places), map(other.distance_m, self.places)
        return max(*there, *back)


class SuccessVerdict:
    """Decides whether a flight has succeeded.

    Attributes:
        goal_enu_m: Goal, of shape (3,), in metres.
        landed: True if the vehicle has flown and stands disarmed on the ground.
        flew: True once the vehicle has been in the air.

    Raises:
        RecordError: The golden flight that defines the corridor cannot be read.
        ConfigError: The trace of the golden flight has fewer than two positions, or one that is not
            finite.
    """

    def __init__(self, success: SuccessConfig, crew: Crew) -> None:
        self._success, self._crew = success, crew
        self.goal_enu_m: FloatArray | None = None
        self.landed = self.flew = False
        self._rest_since_s = math.inf
        self._rests = False
        self._path = None if success.golden is None else FlownPath.of(Path(success.golden))
        self._away_m = 0.0  # largest distance of the vehicle from the golden path
        # Smallest distance of the vehicle from each position of the golden path.
        self._missed_m = np.full(0 if self._path is None else len(self._path.places), np.inf)

    def see(self, state: VehicleState) -> None:
        """Update the verdict with a new state of the vehicle."""
        if self._path is not None:
            place = state.position_enu_m
            self._away_m = max(self._away_m, self._path.distance_m(place))
            steps_m = np.sqrt(((self._path.places - place) ** 2).sum(axis=1))
            self._missed_m = np.fmin(self._missed_m, steps_m)
        near_m = self._success.goal_m
        assert self.goal_enu_m is not None
        if (
            near_m is None
            or not self.flew
            or norm(state.position_enu_m - self.goal_enu_m) > near_m
            or norm(state.velocity_enu_mps) > _REST_MPS
        ):
            self._rest_since_s, self._rests = math.inf, False
        else:
            self._rest_since_s = min(self._rest_since_s, state.stamp_s)
            self._rests = state.stamp_s - self._rest_since_s >= _REST_S

    def describe(self) -> str:
        """Describe the configured conditions of success, and whether there was a flight."""
        success = self._success
        parts = (
            "" if success.goal_m is None else f"at rest within {success.goal_m:g} m of the goal",
            "landed" if success.landed else "",
            "" if success.exit is None else f"{success.exit} ended with code 0",
            "" if success.corridor_m is None else f"within {success.corridor_m:g} m of the path",
            "" if self.flew else "without a flight",
        )
        return ", ".join(filter(None, parts))

    def deviation(self) -> str:
        """Return how the whole flight left the corridor, or an empty string if it did not.

        The vehicle leaves the corridor if it strays from the golden path, or misses a part of it.
        """
        corridor_m, missed_m = self._success.corridor_m, max(self._missed_m, default=0.0)
        if corridor_m is not None and self._away_m > corridor_m:
            return f"up to {self._away_m:.1f} m from the golden path"
        if corridor_m is not None and missed_m > corridor_m:
            return f"part of the golden path was missed by {missed_m:.1f} m"
        return ""

    def is_over(self) -> bool:
        """Return True if all configured conditions of success hold, apart from the corridor.

        If no such condition is configured, return True once every program has ended.
        """
        success = self._success
        ends = (
            *([self._rests] if success.goal_m is not None else ()),
            *([self.landed] if success.landed else ()),
            *([self._crew.succeeded(success.exit)] if success.exit is not None else ()),
        )
        return all(ends or (self._crew.over,))
