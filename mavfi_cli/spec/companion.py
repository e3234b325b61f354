"""A user's own companion: its programs, and the conditions of its success."""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import shlex
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from mavfi_cli.core.config import load_toml
from mavfi_cli.core.errors import ConfigError, LinkError, UnknownName
from mavfi_cli.core.files import gains_rights
from mavfi_cli.core.types import StackMark

RESTARTS = ("never", "on-failure", "always")
ACTIONS, ON_ERROR = ("hold", "brake", "autopilot"), ("open", "closed")
TIMES = ("wall", "lockstep")
_ANY_PORT = {"wall": "udpin:127.0.0.1:0", "lockstep": "tcpin:127.0.0.1:0"}
PLACEHOLDERS = (
    "link", "mavsdk", "port", "free", "briefing", "camera", "world", "start", "goal", "seed",
)  # fmt: skip
# {{word}} stands for the text {word}; ${word} is a variable of a shell.
_PLACEHOLDER = re.compile(r"\{\{([a-z]+)\}\}|(?<!\$)\{([a-z]+)\}")
_LONGEST_S = 3600.0
LIMITS = {  # minimum and maximum of each number
    "restart_s": (0.0, _LONGEST_S),
    "ready_port": (1.0, 65_535.0),
    "ready_limit_s": (0.1, _LONGEST_S),
    "share": (0.01, 1.0),
    "goal_m": (0.1, 50.0),
    "corridor_m": (0.01, 1e4),
    "patience": (0.0, 1000.0),
    "stale_s": (0.1, _LONGEST_S),
    "answer_limit_s": (0.1, _LONGEST_S),
    "time_limit_s": (1.0, 86_400.0),
    "flight_s": (0.1, 86_400.0),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class ProgramConfig:
    """One program of a user's companion: how mavfi starts, awaits and restarts it.

    Attributes:
        command: Command line, which runs without a shell. Placeholders in braces are filled in.
        folder: Working folder, relative to the file of the companion.
        environment: Variables added to the environment of mavfi. TMPDIR is a folder that mavfi
            removes after the flight. PYTHONUNBUFFERED is 1 unless it is set.
        restart: When to restart the program after it has ended: never, on-failure or always.
        restart_s: Wall-clock time from the program's end to its restart, s.
        ready_line: Regular expression for a line on stdout after which the program is ready.
        ready_port: TCP port of this machine that the program opens when it is ready.
        ready_heartbeat: The program is ready when the first MAVLink heartbeat arrives from a system
            and component that had sent none before the program started.
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
        self._check_texts()
        for name in self.placeholders:
            if name not in PLACEHOLDERS:
                problem = UnknownName("placeholder", name, PLACEHOLDERS)
                raise ConfigError(
                    f"{problem}; write {{{{{name}}}}} for the text {{{name}}}", key="command"
                )
        if self.restart not in RESTARTS:
            raise UnknownName("restart rule", self.restart, RESTARTS)
        ConfigError.check_limits(self, LIMITS)
        try:
            re.compile((self.ready_line or "").encode())
        except (re.error, UnicodeError) as error:
            raise ConfigError(f"must be a regular expression: {error}", key="ready_line") from None

    def _check_texts(self) -> None:
        """Reject what the operating system cannot pass on: NUL, and names without a value."""
        if "\0" in self.command:
            raise ConfigError("must not contain NUL", key="command")
        for name, value in self.environment.items():
            if not name or "=" in name or "\0" in name + value:
                raise ConfigError(f"cannot set the variable {name!r}", key="environment")

    @property
    def placeholders(self) -> list[str]:
        """Names of the placeholders in the command."""
        return [name for _, name in _PLACEHOLDER.findall(self.command) if name]

    def argv(self, values: Mapping[str, str]) -> list[str]:
        """Split the command into words, and replace each placeholder with its value in `values`."""

        def filled(match: re.Match[str]) -> str:
            return f"{{{match[1]}}}" if match[1] else values[match[2]]

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
        goal_m: The vehicle has flown, and moves at less than 0.5 m/s for 1 s within this distance
            of the goal, m.
        landed: The vehicle stands on the ground, disarmed, after a flight that no failsafe of the
            autopilot has ended.
        exit: Name of a program that must have exited with code 0.
        corridor_m: The vehicle was never farther than this from the path of `golden`, m, and every
            place of that path was within this distance of the vehicle once.
        golden: Run folder of the flight whose path `corridor_m` refers to, relative to the file of
            the companion.
    """

    goal_m: float | None = None
    landed: bool = False
    exit: str | None = None
    corridor_m: float | None = None
    golden: str | None = None

    def __post_init__(self) -> None:
        ConfigError.check_limits(self, LIMITS)
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
        ConfigError.check_limits(self, LIMITS)


@dataclass(frozen=True, slots=True, kw_only=True)
class CompanionConfig:
    """A user's companion: its programs keyed by name, its MAVLink link and its success conditions.

    Attributes:
        program: Programs in the order in which they start; each waits until the one before is
            ready.
        time: Clock of the flight: `wall`, the wall clock, or `lockstep`, in which every tick waits
            for the companion's answer.
        answer_limit_s: Longest wall-clock time until an answer in lockstep, s.
        link: mavfi's end of the companion's MAVLink link, on this machine. By default it listens on
            a free port: `udpin:127.0.0.1:0` with the wall clock, `tcpin:127.0.0.1:0` in lockstep.
            `udpout:127.0.0.1:PORT` sends to a program that listens on a fixed port, as PX4 does.
        success: Conditions of success. Without `goal_m`, `landed` and `exit`, the last program must
            have exited with code 0.
        time_limit_s: Limit of simulated time from arming, s, if it is shorter than the mission's.
        flight_s: Simulated time from arming over which random faults are drawn, s; None for the
            flight time of `success.golden` or, without it, the duration of a straight flight to the
            goal at the speed limit.
        key_file: File with the signing passphrase of the link, relative to this file. The vehicle
            then signs its messages and accepts only signed ones. A message that a fault changes,
            repeats or delays is signed again.
        gate: Behaviour of the gate with `--detector`.
        name: Name of the companion, which detector models that are fitted to it store; None for the
            name of its file, or "companion".
        own_network: In a campaign, each mission has a network of its own with only a loopback, if
            the operating system allows it, so that fixed ports do not collide.
        camera_heartbeat: The camera component sends heartbeats. MAVProxy and DroneKit mistake them
            for those of a vehicle.
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
        ConfigError.check_limits(self, LIMITS)
        if (self.flight_s or 0.0) > (self.time_limit_s or math.inf):
            raise ConfigError("must be at most time_limit_s", key="flight_s")
        if self.success.exit is not None and self.success.exit not in self.program:
            raise UnknownName("program", self.success.exit, self.program)
        if self.time not in TIMES:
            raise ConfigError(f"must be 'wall' or 'lockstep', got {self.time!r}", key="time")
        if self.link is None:
            object.__setattr__(self, "link", _ANY_PORT[self.time])
        self._check_link()
        if self.in_lockstep:
            self._check_lockstep()
        if self.success.is_open:
            last = replace(self.success, exit=list(self.program)[-1])
            object.__setattr__(self, "success", last)
        ends = self.success.exit
        if ends is not None and self.program[ends].restart == "always":
            raise ConfigError(
                "always restarts, so it never counts as ended: set success.landed or "
                "success.goal_m, or another success.exit", key=f"program.{ends}.restart",
            )  # fmt: skip

    def _check_link(self) -> None:
        """Reject a link beyond this machine, and one that needs a listening program."""
        from mavfi_cli.link.endpoint import parse_endpoint

        try:
            end = parse_endpoint(self.url)
        except LinkError as error:
            raise ConfigError(str(error), key="link") from None
        known = end.scheme in ("udpin", "udpout", "tcpin")
        if not known or end.host not in ("127.0.0.1", "localhost"):
            raise ConfigError(
                f"must be udpin:, udpout: or tcpin: on 127.0.0.1, got {self.url}", key="link"
            )

    def _check_lockstep(self) -> None:
        """Reject settings that lockstep does not support.

        These are links other than `tcpin`, a key, a second program, and settings that need the wall
        clock.
        """
        if not self.url.startswith("tcpin:"):
            raise ConfigError("must be a tcpin: URL in lockstep; UDP may lose ticks", key="link")
        if self.key_file is not None:
            raise ConfigError("has no effect in lockstep; remove it", key="key_file")
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
    def fixed_ports(self) -> list[int]:
        """Ports of this machine that every flight uses: of the link, and of ready programs."""
        from mavfi_cli.link.endpoint import parse_endpoint

        ports = [parse_endpoint(self.url).port, *(own.ready_port for own in self.program.values())]
        return [port for port in ports if port]

    @property
    def mark(self) -> StackMark:
        """Identity that detector models of this companion store: its name, and a digest.

        The digest is that of the programs' names and commands.
        """
        commands = {name: program.command for name, program in self.program.items()}
        digest = hashlib.sha256(json.dumps(commands).encode()).hexdigest()
        return StackMark.of_companion(self.name or "companion", digest)

    def uses(self, placeholder: str) -> bool:
        """Return True if the command of any program contains `placeholder` in braces."""
        return any(placeholder in own.placeholders for own in self.program.values())

    @property
    def files(self) -> tuple[str, ...]:
        """Path of the binary or of the Python script that each command runs, if not on PATH."""
        here, found = Path.cwd(), []
        for program in self.program.values():
            words = _words(program.command)
            words = words[Path(words[0]).name.startswith("python") :]
            places = (Path(program.folder) / word for word in words)
            if (place := next(filter(os.path.isfile, places), None)) is not None:
                found.append(place.relative_to(here) if place.is_relative_to(here) else place)
        return tuple(dict.fromkeys(map(str, found)))

    @staticmethod
    def is_file(given: str) -> bool:
        """Return True if `--companion` names a TOML file, and False if it is a command line."""
        path = Path(given)
        return path.suffix == ".toml" and (os.path.isfile(given) or len(given.split()) == 1)

    @classmethod
    def load(cls, given: str, *, starts: bool = True) -> CompanionConfig:
        """Load a companion from the TOML file `given`, or build one that runs `given` as a command.

        Args:
            starts: Also check that its programs can be started on this machine, and that the file
                of its passphrase can be read.

        Raises:
            ConfigError: The file cannot be used, or a check has failed.
            UnknownName: A name in the file does not exist.
        """
        path = Path(given)
        if cls.is_file(given):
            loaded = load_toml(path, cls)
            loaded = replace(loaded, name=loaded.name or path.stem)
            base = path.resolve().parent
        else:
            loaded, base = cls(program={"companion": ProgramConfig(command=given)}), Path.cwd()
        placed = {
            name: replace(program, folder=str(base / program.folder))
            for name, program in loaded.program.items()
        }
        key_file = None if loaded.key_file is None else str(base / loaded.key_file)
        if starts:
            for name, program in placed.items():
                _require_startable(name, program)
            if key_file is not None:
                from mavfi_cli.link.transport import signing_from_file  # loads pymavlink

                signing_from_file(key_file)
        success, golden = loaded.success, loaded.success.golden
        if golden is not None:
            success = replace(success, golden=str(base / golden))
        return replace(loaded, program=placed, key_file=key_file, success=success)


def _require_startable(name: str, program: ProgramConfig) -> None:
    """Reject a program whose folder or executable is missing, or that gains rights."""
    word = _words(program.command)[0]
    if not Path(program.folder).is_dir():
        raise ConfigError(f"no such folder: {program.folder}", key=f"program.{name}.folder")
    place = str(Path(program.folder) / word) if "/" in word else word
    path = program.environment.get("PATH", os.environ.get("PATH"))
    if (binary := shutil.which(place, path=path)) is None:
        raise ConfigError(
            f"program {word!r} was not found or is not executable", key=f"program.{name}"
        )
    if gains_rights(Path(binary)):
        problem = (
            f"{word} is set-uid or set-gid or has file capabilities, so mavfi could neither end "
            "nor attack it"
        )
        raise ConfigError(problem, key=f"program.{name}")
