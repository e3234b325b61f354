"""Workers fly missions: what the runner knows of those on this machine, and of a cluster's."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self


@dataclass(frozen=True, slots=True, kw_only=True)
class AttemptEnd:
    """How one attempt at a mission ended.

    Attributes:
        exit: code with which the mission's process ended; None where it was killed.
        signal: that killed it; None where its guard was killed too, or the time ran out.
        timeout: the limit of wall time passed.
        report: the mission's own last words: folder, or error and text, or traceback.
        lost: why nobody knows how it ended.
        wall_s: of the whole attempt, the guard's own work included.
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
        number: of the mission.
        changes: what it has other than by default.
        out: the folder that is to hold what it leaves.
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
        """How many missions may be started now."""

    @abstractmethod
    def start(self, mission: Assignment, limit_s: float) -> None:
        """Start a mission that has `limit_s` of wall time."""

    @abstractmethod
    def wait(self, timeout_s: float) -> list[AttemptEnd]:
        """The missions that ended, waiting for news or the time-out."""

    @abstractmethod
    def close(self) -> None:
        """End what is still running."""
