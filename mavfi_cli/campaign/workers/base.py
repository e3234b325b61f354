"""The interface of workers, on this machine or on a cluster."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self


@dataclass(frozen=True, slots=True, kw_only=True)
class AttemptEnd:
    """How one attempt at a mission ended.

    Attributes:
        exit: exit code of the mission's process; None if it was killed.
        signal: signal that killed it; None if its guard was killed too, or the time ran out.
        timeout: true if the limit of wall time passed.
        report: the mission's last message: folder, or error and text, or traceback.
        lost: why its end is unknown.
        wall_s: wall time of the whole attempt, the guard's work included, s.
    """

    number: int
    exit: int | None = None
    signal: int | None = None
    timeout: bool = False
    report: Mapping[str, Any] | None = None
    lost: str = "its guard was killed"
    wall_s: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Assignment:
    """One mission to be flown.

    Attributes:
        number: number of the mission.
        changes: its values that differ from the defaults.
        out: the folder for its run folder.
    """

    number: int
    changes: Mapping[str, Any]
    out: str


class Workers(ABC):
    """Keeps missions flying. A context manager that ends them."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    @abstractmethod
    def free(self) -> int:
        """Number of missions that may be started now."""

    @abstractmethod
    def start(self, mission: Assignment, limit_s: float) -> None:
        """Start a mission with a limit of wall time, s."""

    @abstractmethod
    def wait(self, timeout_s: float) -> list[AttemptEnd]:
        """Wait for news or the time-out; return the missions that ended."""

    @abstractmethod
    def close(self) -> None:
        """End all missions that still run."""
