"""The errors that users see. Each one composes its own one-line message."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from enum import Enum
from pathlib import Path
from typing import Self, TypeVar

E = TypeVar("E", bound=Enum)


class MavfiError(Exception):
    """A known error. The command line prints it in one line and exits with `exit_code`."""

    exit_code = 1


def described(error: BaseException) -> str:
    """Return an error's type and message. A lone surrogate, which UTF-8 lacks, is escaped."""
    return f"{type(error).__name__}: {error}".encode(errors="backslashreplace").decode()


def printable(text: str) -> str:
    """Return a line in which every character that could control a terminal is replaced."""
    return "".join(c if c.isprintable() else "\ufffd" for c in text)


def lack_of(error: Exception) -> str:
    """Describe what is wrong with a file's contents, from the error that using them raised."""
    match error:
        case KeyError():
            return f"it has no {error}"
        case TypeError() | AttributeError():
            return "a value in it has the wrong type"
        case RecursionError():
            return "its values are nested too deeply"
        case _:
            return printable(str(error)) or type(error).__name__


def nearest(name: str, known: Iterable[str]) -> str | None:
    """Return the known name most similar to `name`, ignoring case and folder, or None."""
    for candidate in known:
        if candidate.endswith(f"/{name}"):
            return candidate
    spelled = {candidate.lower(): candidate for candidate in known}
    alike = [lower for lower in spelled if lower[:1] == name[:1].lower()]
    for names, cutoff in ((spelled, 0.6), (alike, 0.5)):
        if matches := difflib.get_close_matches(name.lower(), names, n=1, cutoff=cutoff):
            return spelled[matches[0]]
    return None


def _suggestion(name: str, known: Iterable[str]) -> str:
    names = sorted(known)
    match = nearest(name, names)
    listed = ", ".join(names)
    return f"did you mean {match!r}? Known: {listed}" if match else f"known: {listed}"


class UnknownName(MavfiError):
    """An unknown name, which is a usage error. The message suggests the nearest known name."""

    exit_code = 2

    def __init__(self, kind: str, name: str, known: Iterable[str]) -> None:
        super().__init__(f"unknown {kind} {name!r}; {_suggestion(name, known)}")


def named_member(kind: type[E], what: str, name: str | E) -> E:
    """Return the enumeration member with this value.

    Raises:
        UnknownName: No member has this value. The message suggests the nearest.
    """
    try:
        return kind(name)
    except ValueError:
        raise UnknownName(what, str(name), [str(member.value) for member in kind]) from None


class ConfigError(MavfiError):
    """A file or value that cannot be used. The message gives file, line, key and problem."""

    def __init__(
        self, problem: str, *, path: Path | None = None, line: int | None = None, key: str = ""
    ) -> None:
        self.problem, self.path, self.key = problem, path, key
        place = ""
        if path is not None:
            place = f"{path}:{line}: " if line is not None else f"{path}: "
        named = f"{key}: " if key else ""
        super().__init__(f"{place}{named}{problem}")

    @classmethod
    def unknown_key(
        cls, key: str, known: Iterable[str], *, path: Path | None = None, line: int | None = None
    ) -> Self:
        """Return the error for an unknown key. Its message suggests the nearest known key."""
        problem = f"unknown key; {_suggestion(key.rpartition('.')[2], known)}"
        return cls(problem, path=path, line=line, key=key)


class WorldError(MavfiError):
    """The boxes of a world, or the parameters of its generator, are invalid."""


class PlaceError(WorldError):
    """The start or goal is blocked or outside the world, which is a usage error."""

    exit_code = 2


class LinkError(MavfiError):
    """The MAVLink connection failed, cannot be opened, or has no usable vehicle."""


class NoAutopilot(LinkError):
    """No autopilot heartbeat arrived."""


class CommandRefused(LinkError):
    """The autopilot refused a command."""


class LinkLost(LinkError):
    """The peer stopped sending or closed the connection."""


class CannotLift(MavfiError):
    """A vehicle whose rotors cannot lift its payload."""


class VehicleProcessError(MavfiError):
    """The simulated vehicle could not start or ended early; keeps its exit code."""

    def __init__(self, problem: str, exit_code: int = 1) -> None:
        super().__init__(problem)
        self.exit_code = exit_code


class ModelError(MavfiError):
    """A detector model, or its training data, that cannot be used or created."""

    def __init__(self, problem: str, *, path: Path | None = None) -> None:
        super().__init__(problem if path is None else f"{path}: {problem}")


class RecordError(MavfiError):
    """A file or folder of results that cannot be written or read."""


class FaultError(MavfiError):
    """A fault that cannot be described, injected or repeated."""


class FaultSpecError(FaultError):
    """An inconsistent fault description."""


class TracingForbidden(FaultError):
    """The operating system does not permit tracing. The message explains how to allow it."""

    def __init__(self, what: str, problem: str, remedy: str) -> None:
        super().__init__(f"{what} is not possible here ({problem}): {remedy}")


class TargetError(FaultError):
    """A target program that cannot be started or that ends before the trigger."""

    def __init__(self, program: str, problem: str) -> None:
        super().__init__(f"{program}: {problem}")


class BuildMismatch(FaultError):
    """A fault record from another build. The message names every object that differs."""

    def __init__(self, differences: Iterable[str]) -> None:
        super().__init__(f"the record comes from another build: {'; '.join(differences)}")


class Interrupted(MavfiError):
    """The user requested a stop."""
