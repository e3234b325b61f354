"""A user's own companion: its programs, and the conditions of its success."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shlex
import shutil
import stat
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from mavfi_cli.core.config import load_toml
from mavfi_cli.core.errors import ConfigError, UnknownName
from mavfi_cli.core.types import StackMark
from mavfi_cli.spec.detector import COMPANION

RESTARTS = ("never", "on-failure", "always")
ACTIONS, ON_ERROR = ("hold", "brake", "autopilot"), ("open", "closed")
TIMES = ("wall", "lockstep")
ANY_PORT = {"wall": "udpin:127.0.0.1:0", "lockstep": "tcpin:127.0.0.1:0"}
_PLACEHOLDER = re.compile(r"\{([a-z]+)\}")
_LONGEST_S = 3600.0


def _require_range(key: str, value: float | None, low: float, high: float) -> None:
    if value is not None and not low <= value <= high:
        raise ConfigError(f"must be between {low:g} and {high:g}, got {value:g}", key=key)


@dataclass(frozen=True, slots=True, kw_only=True)
class ProgramConfig:
    """One program of a user's companion: how mavfi starts, awaits and restarts it.

    Attributes:
        command: Command line. Placeholders in braces are filled in.
        folder: Working folder, relative to the file of the companion.
        environment: Variables added to the environment of mavfi. TMPDIR is a folder that mavfi
            removes after the flight.
        restart: When to restart the program after it has ended: never, on-failure or always.
        restart_s: Wall-clock time from the program's end to its restart, s.
        ready_line: Regular expression for a line on stdout after which the program is ready.
        ready_port: TCP port of this machine that the program opens when it is ready.
        ready_heartbeat: The program is ready when the first MAVLink heartbeat arrives from a system
            and component of which none had arrived before the program started.
        ready_limit_s: Longest wall-clock time until the program is ready, s.
        share: Share of the time for which the program may run. Below 1, it is stopped for the rest
            of every 20 ms, as on a slower computer.
    """

    command: str
    folder: str = "."
    environment: dict[str, str] = field(default_factory=dict)
    restart: str = RESTARTS[0]
    restart_s: float = 1.0
    ready_line: str | None = None
    ready_port: int | None = None
    ready_heartbeat: bool = False
    ready_limit_s: float = 60.0
    share: float = 1.0

    def __post_init__(self) -> None:
        if not _words(self.command):
            raise ConfigError("must name a program, but is empty", key="command")
        if self.restart not in RESTARTS:
            raise UnknownName("restart rule", self.restart, RESTARTS)
        _require_range("restart_s", self.restart_s, 0.0, _LONGEST_S)
        _require_range("ready_port", self.ready_port, 1, 65_535)
        _require_range("share", self.share, 0.01, 1.0)
        _require_range("ready_limit_s", self.ready_limit_s, 0.1, _LONGEST_S)
        try:
            re.compile(self.ready_line or "")
        except re.error as error:
            raise ConfigError(f"must be a regular expression: {error}", key="ready_line") from None

    def argv(self, values: Mapping[str, str]) -> list[str]:
        """Split the command into words, and replace each placeholder with its value in `values`.

        Raises:
            UnknownName: A name in braces is not a key of `values`. The error suggests the nearest.
        """

        def filled(match: re.Match[str]) -> str:
            if match[1] not in values:
                raise UnknownName("placeholder", match[1], values)
            return values[match[1]]

        return [_PLACEHOLDER.sub(filled, word) for word in _words(self.command)]


def _words(command: str) -> list[str]:
    try:
        return shlex.split(command)
    except ValueError as error:
        raise ConfigError(f"cannot be split into words: {error}", key="command") from None


@dataclass(frozen=True, slots=True, kw_only=True)
class SuccessConfig:
    """The conditions under which a flight of a user's companion is a success.

    All conditions that are set must hold, and no collision may occur.

    Attributes:
        goal_m: The vehicle is at rest within this distance of the goal, m.
        landed: The vehicle stands on the ground, disarmed, after a flight that no failsafe of the
            autopilot has ended.
        exit: Name of a program that must have exited with code 0.
        corridor_m: The vehicle was never farther than this from the path of `golden`, m.
        golden: Run folder of the flight whose path `corridor_m` refers to, relative to the current
            folder.
    """

    goal_m: float | None = None
    landed: bool = False
    exit: str | None = None
    corridor_m: float | None = None
    golden: str | None = None

    def __post_init__(self) -> None:
        _require_range("goal_m", self.goal_m, 0.1, 50.0)
        _require_range("corridor_m", self.corridor_m, 0.01, 1e4)
        if (self.corridor_m is None) != (self.golden is None):
            raise ConfigError(
                "must be given together with golden, the run folder of the flight to stay close to",
                key="corridor_m",
            )

    @property
    def is_open(self) -> bool:
        """True if no condition says when the flight is over."""
        return self.goal_m is None and self.exit is None and not self.landed


@dataclass(frozen=True, slots=True, kw_only=True)
class GateConfig:
    """How the gate between a user's companion and the autopilot reacts to alarms and errors.

    Attributes:
        action: What replaces a setpoint that raises an alarm: `hold`, the last accepted setpoint;
            `brake`, a standstill; `autopilot`, nothing, and the autopilot is switched to its own
            hold.
        patience: Number of consecutive alarms after which `hold` becomes `brake`.
        stale_s: Time after which setpoints that no longer change are withheld if the companion
            has ended or is silent, s.
        on_error: Whether setpoints pass (`open`) or not (`closed`) after an error in the gate.
        watch_only: Report alarms, but withhold nothing.
    """

    action: str = ACTIONS[0]
    patience: int = 5
    stale_s: float = 1.0
    on_error: str = ON_ERROR[0]
    watch_only: bool = False

    def __post_init__(self) -> None:
        if self.action not in ACTIONS:
            raise UnknownName("action", self.action, ACTIONS)
        if self.on_error not in ON_ERROR:
            raise UnknownName("on_error", self.on_error, ON_ERROR)
        _require_range("patience", self.patience, 0, 1000)
        _require_range("stale_s", self.stale_s, 0.1, _LONGEST_S)


@dataclass(frozen=True, slots=True, kw_only=True)
class CompanionConfig:
    """A user's companion: its programs keyed by name, its MAVLink link and its success conditions.

    Attributes:
        program: Programs in the order in which they start; each waits until the one before is
            ready.
        time: Clock of the flight: `wall`, the wall clock, or `lockstep`, in which every tick waits
            for the companion's answer.
        answer_limit_s: Longest wall-clock time until an answer in lockstep, s.
        link: mavfi's end of the companion's MAVLink link. By default it listens on a free
            port: UDP with the wall clock, TCP in lockstep. `udpout` connects to a program that
            listens on a fixed port, as PX4 does.
        success: Conditions of success. Without `goal_m`, `landed` and `exit`, the last program must
            have exited with code 0.
        time_limit_s: Limit of simulated time from arming, s, if it is shorter than the mission's.
        flight_s: Simulated time from arming over which random faults are drawn, s; None for the
            flight time of `success.golden` or, without it, the duration of a straight flight to the
            goal at the speed limit.
        key_file: File with the signing passphrase of the link, relative to this file. A message
            that a fault changes is signed again with it.
        gate: Behaviour of the gate with `--detector`.
        name: Name of the companion, which detector models that are fitted to it store; None for the
            name of its file, or "companion".
        own_network: In a campaign, each mission has a network of its own with only a loopback, if
            the operating system allows it, so that fixed ports do not collide.
        camera_heartbeat: The camera component sends heartbeats. MAVProxy and DroneKit mistake them
            for those of a second vehicle.
    """

    program: dict[str, ProgramConfig]
    time: str = TIMES[0]
    answer_limit_s: float = 60.0
    link: str | None = None
    success: SuccessConfig = field(default_factory=SuccessConfig)
    time_limit_s: float | None = None
    flight_s: float | None = None
    key_file: str | None = None
    gate: GateConfig = field(default_factory=GateConfig)
    name: str | None = None
    own_network: bool = True
    camera_heartbeat: bool = True

    def __post_init__(self) -> None:
        if not self.program:
            raise ConfigError("must have at least one program", key="program")
        for name in self.program:
            if not re.fullmatch(r"[A-Za-z0-9_-]{1,40}", name):
                raise ConfigError(
                    f"the name must be 1 to 40 letters, digits, - or _, got {name!r}", key=name
                )
        _require_range("time_limit_s", self.time_limit_s, 1.0, 86_400.0)
        _require_range("flight_s", self.flight_s, 0.1, 86_400.0)
        if self.success.exit is not None and self.success.exit not in self.program:
            raise UnknownName("program", self.success.exit, self.program)
        _require_range("answer_limit_s", self.answer_limit_s, 0.1, _LONGEST_S)
        if self.time not in TIMES:
            raise UnknownName("time", self.time, TIMES)
        if self.link is None:
            object.__setattr__(self, "link", ANY_PORT[self.time])
        if self.in_lockstep:
            self._check_lockstep()
        if self.success.is_open:
            last = replace(self.success, exit=list(self.program)[-1])
            object.__setattr__(self, "success", last)

    def _check_lockstep(self) -> None:
        """Reject settings that lockstep does not support.

        These are links other than `tcpin`, a second program, and settings that need the wall clock.
        """
        if not self.url.startswith("tcpin:"):
            raise ConfigError("must be a tcpin: URL in lockstep; UDP may lose ticks", key="link")
        if len(self.program) > 1:
            raise ConfigError("must contain only one program in lockstep", key="program")
        plain = ProgramConfig(command="true")
        for name, program in self.program.items():
            for key in ("restart", "ready_line", "ready_port", "ready_heartbeat", "share"):
                if getattr(program, key) != getattr(plain, key):
                    raise ConfigError(
                        "has no effect in lockstep; set time = 'wall' or remove it",
                        key=f"program.{name}.{key}",
                    )

    @property
    def in_lockstep(self) -> bool:
        """True if every tick waits for the companion's answer."""
        return self.time == "lockstep"

    @property
    def url(self) -> str:
        """URL of mavfi's end of the link."""
        assert self.link is not None
        return self.link

    @property
    def mark(self) -> StackMark:
        """Identity that detector models of this companion store: its name, and a digest.

        The digest is that of the programs' names and commands.
        """
        commands = {name: program.command for name, program in self.program.items()}
        digest = hashlib.sha256(json.dumps(commands).encode()).hexdigest()
        return StackMark(name=f"{COMPANION}{self.name or 'companion'}", digest=digest)

    def uses(self, placeholder: str) -> bool:
        """Return True if the command of any program contains `placeholder` in braces."""
        return any(
            placeholder in _PLACEHOLDER.findall(own.command) for own in self.program.values()
        )

    @classmethod
    def load(cls, given: str) -> CompanionConfig:
        """Load a companion from the TOML file `given`, or build one that runs `given` as a command.

        Raises:
            ConfigError: The file cannot be used, or a program cannot be started.
            UnknownName: A name in the file does not exist.
        """
        path = Path(given)
        if path.suffix == ".toml":
            loaded = load_toml(path, cls)
            loaded = replace(loaded, name=loaded.name or path.stem)
            base = path.resolve().parent
        else:
            loaded, base = cls(program={"companion": ProgramConfig(command=given)}), Path.cwd()
        placed = {
            name: replace(program, folder=str(base / program.folder))
            for name, program in loaded.program.items()
        }
        for name, program in placed.items():
            _require_startable(name, program)
        key_file = None if loaded.key_file is None else str(base / loaded.key_file)
        return replace(loaded, program=placed, key_file=key_file)


def _require_startable(name: str, program: ProgramConfig) -> None:
    """Reject a program whose folder or executable is missing, or that is set-uid or set-gid."""
    word = _words(program.command)[0]
    if not Path(program.folder).is_dir():
        raise ConfigError(f"no such folder: {program.folder}", key=f"program.{name}.folder")
    place = str(Path(program.folder) / word) if "/" in word else word
    path = program.environment.get("PATH", os.environ.get("PATH"))
    if (binary := shutil.which(place, path=path)) is None:
        raise ConfigError(
            f"program {word!r} was not found or is not executable", key=f"program.{name}"
        )
    if os.stat(binary).st_mode & (stat.S_ISUID | stat.S_ISGID):
        problem = f"{word} is set-uid or set-gid, so mavfi could neither end nor attack it"
        raise ConfigError(problem, key=f"program.{name}")
