"""The errors that users see. Each one composes its own one-line message."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from enum import Enum
from pathlib import Path
from typing import Self, TypeVar

E = TypeVar("E", bound=Enum)
_LISTED = 40  # known names that an error lists: MAVLink has hundreds of messages and fields


class MavfiError(Exception):
    """Base class of all errors that mavfi raises for users.

    The command line prints the message in one line and exits with `exit_code`.
    """

    exit_code = 1

    def as_usage(self) -> Self:
        """Return this error with the exit code of a usage error, 2."""
        self.exit_code = 2
        return self


def described(error: BaseException) -> str:
    """Return the type and the message of an error as `TYPE: MESSAGE`.

    Lone surrogates, which UTF-8 cannot encode, are escaped.
    """
    return f"{type(error).__name__}: {error}".encode(errors="backslashreplace").decode()


def printable(text: str) -> str:
    """Return a copy of `text` in which every character that could control a terminal is replaced.

    Newlines are replaced, too.
    """
    return "".join(c if c.isprintable() else "\ufffd" for c in text)


def lack_of(error: Exception) -> str:
    """Return a phrase for what is wrong with a file.

    Args:
        error: The exception that was raised when the contents of the file were used.
    """
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
    """Return the known name that is most similar to `name`, or None if none is similar enough.

    Case and the folder in a known name are ignored.
    """
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
    more = len(names) - _LISTED
    listed = ", ".join(names) if more <= 0 else f"{', '.join(names[:_LISTED])} and {more} more"
    return f"did you mean {match!r}? Known: {listed}" if match else f"known: {listed}"


class UnknownName(MavfiError):
    """The user gave a name that does not exist. The message suggests the nearest known name.

    It is a usage error.

    Args:
        kind: What the name should be the name of, such as `world`.
        name: The unknown name.
        known: All known names.
    """

    exit_code = 2

    def __init__(self, kind: str, name: str, known: Iterable[str]) -> None:
        super().__init__(f"unknown {kind} {name!r}; {_suggestion(name, known)}")


def named_member(kind: type[E], what: str, name: str | E) -> E:
    """Return the member of the enumeration `kind` whose value is `name`.

    Args:
        what: What `name` names, for the error message.

    Raises:
        UnknownName: No member has this value. The message suggests the nearest.
    """
    try:
        return kind(name)
    except ValueError:
        raise UnknownName(what, str(name), [str(member.value) for member in kind]) from None


class ConfigError(MavfiError):
    """A setting or a file of settings cannot be used.

    The message gives the file, the line, the key and the problem, as far as they are known.
    """

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
        """Create the error for a key that does not exist. It suggests the nearest known key."""
        problem = f"unknown key; {_suggestion(key.rpartition('.')[2], known)}"
        return cls(problem, path=path, line=line, key=key)

    @classmethod
    def check_limits(cls, config: object, limits: Mapping[str, tuple[float, float]]) -> None:
        """Raise the error for the first number of `config` that is below or above its limits.

        A setting that `config` does not have, or that is None, is not checked.
        """
        for key, (low, high) in limits.items():
            value = getattr(config, key, None)
            if value is not None and not low <= value <= high:
                problem = f"must be between {low:.10g} and {high:.10g}, got {value:.10g}"
                raise cls(problem, key=key)


class WorldError(MavfiError):
    """The boxes of a world, or the parameters of its generator, are invalid."""


class PlaceError(WorldError):
    """The start or the goal of a mission is blocked or outside the world. It is a usage error."""

    exit_code = 2


class LinkError(MavfiError):
    """The MAVLink connection failed, cannot be opened, or has no usable vehicle."""


class NoAutopilot(LinkError):
    """No heartbeat of an autopilot arrived in time."""


class CommandRefused(LinkError):
    """The autopilot refused a command."""


class LinkLost(LinkError):
    """The other end of a MAVLink connection stopped sending, or closed the connection."""


class CannotLift(MavfiError):
    """The rotors of a vehicle cannot lift its payload."""


class VehicleProcessError(MavfiError):
    """The process of the simulated vehicle could not start, or ended early.

    Attributes:
        exit_code: Exit code of that process, or 1. The command line exits with it, too.
    """

    def __init__(self, problem: str, exit_code: int = 1) -> None:
        super().__init__(problem)
        self.exit_code = exit_code


class ModelError(MavfiError):
    """A detector model, or the data to train it, cannot be used or created."""

    def __init__(self, problem: str, *, path: Path | None = None) -> None:
        super().__init__(problem if path is None else f"{path}: {problem}")


class RecordError(MavfiError):
    """A file or folder of results cannot be written or read."""


class FaultError(MavfiError):
    """A fault is badly described, or it cannot be injected or repeated."""


class FaultSpecError(FaultError):
    """The description of a fault is invalid or contradicts itself."""


_ALLOW_TRACING = (
    "run as the parent of the target, set kernel.yama.ptrace_scope to 0 or 1, or start the "
    "container with --cap-add=SYS_PTRACE"
)


class TracingForbidden(FaultError):
    """The operating system does not allow mavfi to trace a process.

    The message explains how to allow it.

    Args:
        what: What needs tracing, such as `instruction-level injection`.
        problem: What the operating system refused.
        remedy: How to allow it.
    """

    def __init__(self, what: str, problem: str, remedy: str) -> None:
        super().__init__(f"{what} is not possible here ({problem}): {remedy}")

    @classmethod
    def of(cls, error: PermissionError) -> Self:
        """Explain a refusal of ptrace, or of a process's files in /proc."""
        return cls("tracing a process", str(error), _ALLOW_TRACING)


class TargetError(FaultError):
    """The target of a fault cannot be started or used, or ended before the fault was triggered.

    Args:
        program: Name of the target: a program, a process, a node or a flight.
        problem: What went wrong.
    """

    def __init__(self, program: str, problem: str) -> None:
        super().__init__(f"{program}: {problem}")


class BuildMismatch(FaultError):
    """A recorded fault cannot be repeated, because it was recorded with other machine code.

    The message names every executable and library that differs.
    """

    def __init__(self, differences: Iterable[str]) -> None:
        super().__init__(f"the record comes from another build: {'; '.join(differences)}")


class Interrupted(MavfiError):
    """The user asked to stop, for example with Ctrl-C."""
