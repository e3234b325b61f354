"""`mavfi fly`: fly one mission, with live progress, a summary and a run folder."""

from __future__ import annotations

import json
import shlex
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mavfi_cli.cli import types
from mavfi_cli.cli.grouped import (
    Given,
    GroupedCommand,
    given_options,
    refuse_given,
    section,
    spelling,
)
from mavfi_cli.core.errors import ConfigError, FaultSpecError
from mavfi_cli.core.terminal import echo, echo_lines, note_error

if TYPE_CHECKING:
    from mavfi_cli.fi.tracer.record_fields import FaultRecord
    from mavfi_cli.mission.run_folder import Run
    from mavfi_cli.spec.detector import DetectorConfig
    from mavfi_cli.spec.fault import FaultConfig, InstructionConfig
    from mavfi_cli.spec.mission import MissionConfig

_SOURCE = {"at", "exact_bits", "effect", "persistence", "duration_s", "together", "direction"}
_DYING = "has no effect unless a node can die: give --inject process.NODE or --level instruction"
_EITHER = {"bits", "field", "fault_seed"}
_OF_PROGRAM = {"objects", "function"}
_INSTRUCTION = {"sites", "roles", "compat", *_OF_PROGRAM}
_DETECTOR = {"protect", "threshold", "model", "any_stack", "watch"}
_SMALL = 1.0e-3  # largest change that counts as small, relative to the larger of value and 1 unit
_LARGE = [
    "--inject", "waypoint_position", "--all-components", "--field", "exponent",
    "--fault-seed", "20",
]  # fmt: skip
_TOO_SHORT = "the mission ended before"  # reason of a fault whose time came too late
_OUTCOMES = ["success", "collision", "no_path", "timeout", "failsafe", "link_lost", "crash", "hang"]


_mission, _fault = section("Mission"), section("Fault")
_instruction = section("Instruction level")
_detector, _output = section("Detector"), section("Output")


@click.command(cls=GroupedCommand)
@_mission("--config", metavar="FILE", type=click.Path(path_type=Path, exists=True, dir_okay=False),
          help="TOML file of the whole mission. Other options override it. "
               "docs/reference/settings.md lists its keys.")  # fmt: skip
@_mission("--world", type=types.WORLD, default="dense", metavar="NAME|FILE",
          help="World, or a TOML file of boxes; `mavfi world list` lists the worlds.")  # fmt: skip
@_mission("--seed", default=3, help="Root seed of all random draws.")
@_mission("--world-seed", type=int, help="Seed of the world only  [--seed].")
@_mission("--planner", type=types.PLANNER, default="rrtstar",
          help="Planner: rrtstar, rrt, rrtconnect, or the name of a plug-in.")  # fmt: skip
@_mission("--platform", type=types.PLATFORM, default="x86", metavar="NAME|FILE|measured:FACTOR",
          help="Computer whose kernel latencies apply; `mavfi platforms` lists them. `measured` "
               "takes the kernel times of this host times FACTOR and needs "
               "--realtime.")  # fmt: skip
@_mission("--stack", type=types.STACK, default="mavbench", metavar="NAME|FILE",
          help="Structure, checks and gains of the companion; `mavfi stacks` lists the "
               "stacks.")  # fmt: skip
@_mission("--vehicle", type=types.VEHICLE, default="solo", metavar="NAME|FILE",
          help="Simulated vehicle: solo, spark, or a TOML file.")  # fmt: skip
@_mission("--start", metavar="X,Y,Z", type=types.PLACE,
          help="Take-off position, ENU, m  [the world's].")  # fmt: skip
@_mission("--goal", metavar="X,Y,Z", type=types.PLACE,
          help="Goal, ENU, m  [the world's]. A generated world is built around start and goal: "
               "other positions move its bounds, and towers within 3 m of them are left "
               "out.")  # fmt: skip
@_mission("--v-max", "v_max_mps", default=3.0, help="Speed limit, m/s.")
@_mission("--time-limit", "time_limit_s", default=300.0,
          help="Limit of simulated time after take-off, with --companion after arming, "
               "s.")  # fmt: skip
@_mission("--realtime", is_flag=True, help="Pace the simulated vehicle by the wall clock.")
@_mission("--companion", metavar="FILE|CMD",
          help="Fly with your own companion in place of mavfi's: a TOML file or a command line, in "
               "which {link}, {goal} and others are filled in.")  # fmt: skip
@_mission("--speed", default=1.0,
          help="Pace of the vehicle with --companion, in times real time.")  # fmt: skip
@_mission("--golden", "golden", type=types.MISSIONS, metavar="N",
          help="Fly the mission N times without fault and detector, and report how far the flights "
               "of --companion differ.")  # fmt: skip
@_mission("--link", metavar="URL",
          help="Fly a foreign autopilot: udpin:, udpout:, tcp:, tcpin:, serial:.")  # fmt: skip
@_mission("--eyes", is_flag=True,
          help="Start a depth camera and a referee of --world beside the autopilot on --link, with "
               "the body of --vehicle.")  # fmt: skip
@_mission("--origin", metavar="X,Y,Z", type=types.PLACE,
          help="Local origin of the autopilot in the world, ENU, m  [the world's start; with mavfi "
               "sitl, the world's origin].")  # fmt: skip
@_mission("--autopilot", type=types.AUTOPILOT, default="ours", metavar="ours|px4|ardupilot",
          help="Autopilot of the simulated vehicle. px4 and ardupilot start and stop with the "
               "mission.")  # fmt: skip
@_mission("--firmware", metavar="PATH",
          help="SITL binary of px4 or ardupilot  [$PX4_SITL or $ARDUCOPTER_SITL].")  # fmt: skip
@_mission("--key-file", metavar="FILE", type=click.Path(dir_okay=False),
          help="File with the signing passphrase of --link.")  # fmt: skip
@_mission("--loss-limit", "loss_limit_s", default=5.0,
          help="Time without a new state or depth frame after which --link counts as lost, s. It "
               "must pass on the vehicle's clock and on the wall clock.")  # fmt: skip
@_mission("--land/--no-land", default=None,
          help="Land and disarm at the goal  [default: on with --link, else off].")  # fmt: skip
@_fault("--inject", type=types.TARGET, metavar="STAGE|STATE|GROUP",
        help="Corrupt a state: `mavfi states` lists stages, states and groups. Also detector or "
             "detector.PART (the detector's memory), queue.STATE (control's copy of the plan) and "
             "process.NODE (kills the node's process). With --companion: MESSAGE.FIELD, MESSAGE or "
             "process.PROGRAM.")  # fmt: skip
@_fault("--stage", "direction", type=click.Choice(["output", "input"]),
        help="With --companion: strike messages that the companion sends (output) or receives "
             "(input)  [both].")  # fmt: skip
@_fault("--at", default="random", metavar="random|time=S|tick=N|phase=NAME|foreseen|invocation=N",
        help="Trigger. Time and ticks count from when the companion takes control.")  # fmt: skip
@_fault("--fault-seed", default=1, type=types.SEED, help="Seed of all random draws of the fault.")
@_fault("--bits", default=1, type=types.BITS, help="Number of bits to flip.")
@_fault("--field", default="any", type=types.FIELD,
        help="Field of the bits: sign, exponent, mantissa or any.")  # fmt: skip
@_fault("--bit", "exact_bits", multiple=True, type=types.BIT,
        help="Flip this bit instead of a random one; 0 is the lowest. May be "
             "repeated.")  # fmt: skip
@_fault("--all-components", "together", is_flag=True,
        help="Corrupt all states of the group, each with its own bits.")  # fmt: skip
@_fault("--effect", default="flip", type=types.EFFECT,
        help="Effect on a value: flip the bits, zero, random or freeze. On a MAVLink message: "
             "drop, late=S, twice or swap (with the next). On process.PROGRAM: stop or "
             "slow=SHARE  [flip; it kills a process].")  # fmt: skip
@_fault("--persistence", default="transient", type=types.PERSISTENCE,
        help="Persistence: transient (once), stuck-at (held) or intermittent "
             "(repeated).")  # fmt: skip
@_fault("--duration", "duration_s", type=types.ABOVE_ZERO,
        help="Duration of a stuck-at or intermittent fault, or of stop and slow, s  [until the "
             "end].")  # fmt: skip
@_fault("--restart", "node_restart_s", type=types.RESTART, default=1.0,
        help="Time until a dead node works again, s; never means 3600.")  # fmt: skip
@_instruction("--level", type=click.Choice(["source", "instruction"]), default="source",
              help="`instruction` corrupts an operand of one machine instruction of a kernel. "
                   "--inject is then point_cloud, octomap, collision_check, planner, control, "
                   "perception or planning; with --companion, PROGRAM or PROGRAM/EXECUTABLE for a "
                   "process that the program starts.")  # fmt: skip
@_instruction("--site", "sites", multiple=True, type=types.SITE,
              help="Kind of operand: general, flags, vector, x87, mask, instruction-pointer, "
                   "opcode, memory. May be repeated  [the first five: registers].")  # fmt: skip
@_instruction("--role", "roles", multiple=True, type=types.ROLE,
              help="Role of the operand: source or destination  [both].")  # fmt: skip
@_instruction("--compat", type=types.COMPAT, metavar="INJECTOR",
              help="Choose operands and bits as another injector: pinfi, pinfi-bugs, "
                   "rosfi-2021.")  # fmt: skip
@_instruction("--scope", "objects", multiple=True, metavar="OBJECT",
              help="Shared object or executable of a --companion's process to strike. May be "
                   "repeated  [all; in a Python program all but the interpreter].")  # fmt: skip
@_instruction("--function", metavar="NAME",
              help="Strike a --companion's process only in code that executes during calls of this "
                   "function.")  # fmt: skip
@_instruction("--replay", metavar="RUN", type=click.Path(exists=True, file_okay=False),
              help="Strike the instruction that a --companion's flight recorded in this run "
                   "folder, at the same moment.")  # fmt: skip
@_detector("--detector", type=types.DETECTOR, metavar="NAME",
           help="Detector that watches the states and triggers recovery: gad, aad, range, l2, or "
                "the name of a plug-in  [none].")  # fmt: skip
@_detector("--protect", type=types.STAGES, metavar="STAGE,...",
           default="perception,planning,control",
           help="Stages that the detector watches.")  # fmt: skip
@_detector("--threshold", type=float,
           help="Score above which the detector raises an alarm; for gad the number of sigmas  "
                "[the model's].")  # fmt: skip
@_detector("--model", type=click.Path(exists=True, dir_okay=False),
           help="Model file of the detector  [the one shipped for the stack].")  # fmt: skip
@_detector("--any-stack-model", "any_stack", is_flag=True,
           help="Accept a model of another stack. Without --model, use the model of the base "
                "stack.")  # fmt: skip
@_detector("--watch", type=types.WATCH, default="paper", metavar="paper|extended",
           help="States that the detector watches. paper has the 13 of the paper; extended adds "
                "collision and the sequence numbers of plans.")  # fmt: skip
@_output("--out", type=types.OUT, default=Path("runs"), help="Parent of the new run folder.")
@_output("--record", metavar="mcap|rrd", type=click.Choice(["mcap", "rrd"]),
         help="Also record depth frames, clouds and maps: flight.mcap for Foxglove, flight.rrd for "
              "rerun.")  # fmt: skip
@_output("--picture/--no-picture", default=True, help="Draw flight.svg.")
@_output("--expect", type=click.Choice(_OUTCOMES), help="Exit with code 1 if the outcome differs.")
@_output("--json", "as_json", is_flag=True, help="Print result.json instead of the summary.")
@_output("--quiet", is_flag=True, help="No progress on stderr.")
def fly(
    out: Path,
    record: str | None,
    picture: bool,
    expect: str | None,
    as_json: bool,
    quiet: bool,
    config: Path | None,
    golden: int | None,
    replay: str | None,
    **_options: Any,
) -> None:
    """Fly one mission from take-off to the goal, through unknown obstacles.

    A mission that fails still exits with code 0, unless --expect names another outcome.
    """
    from mavfi_cli import library
    from mavfi_cli.cli.progress import progress_view
    from mavfi_cli.mission.progress import Recorder
    from mavfi_cli.report import view as viewers
    from mavfi_cli.report.drawing import write_figure
    from mavfi_cli.report.summary import folder_lines, outcome_line, summary_lines
    from mavfi_cli.report.top_view import draw_top_view
    from mavfi_cli.report.view.entries import ViewedFlight

    mission = _mission_of(config)
    if golden is not None:
        if mission.companion is None:
            raise click.UsageError(
                "--golden needs --companion, because other flights repeat exactly"
            )
        others = {"expect", "record", "replay", "inject", "detector"}
        refuse_given(others, "has no effect with --golden")
        from mavfi_cli.studies.spread import fly_spread

        with progress_view(mission, quiet=quiet) as view:
            spread = fly_spread(mission, golden, out, view)
        text = json.dumps(spread.as_dict(), indent=2)
        echo_lines(text.split("\n") if as_json else spread.lines())
        return
    recorder = Recorder() if record else None
    if record and mission.companion is not None:
        raise click.UsageError(
            "--record cannot be combined with --companion, because it records mavfi's own nodes"
        )
    if record:
        viewers.require_viewer(Path(f"flight.{record}"))
    with progress_view(mission, quiet=quiet) as view:
        run = library.fly(
            mission, out=out, watcher=view, recorder=recorder,
            repeat=None if replay is None else _record_of(Path(replay)),
        )  # fmt: skip
    folder = run.folder
    if record:
        viewers.save(
            [ViewedFlight(name="flight", run=run, recorder=recorder)],
            folder.path / f"flight.{record}",
        )
    if picture:
        write_figure(draw_top_view(run), folder.picture)
    if as_json:
        echo(json.dumps(run.result, indent=2, sort_keys=True))
    else:
        drawn = folder_lines(run, folder.picture if picture else None)
        echo_lines([*summary_lines(run.record), *drawn, *_hint(run)])
    if run.record.outcome == "interrupted":
        raise click.exceptions.Exit(130)
    if expect is not None and run.record.outcome != expect:
        note_error(f"expected {expect}, got {outcome_line(run.record)}")
        raise click.exceptions.Exit(1)


def _hint(run: Run) -> list[str]:
    """Return lines that suggest another setting, if the fault had little or no effect.

    The list is empty unless the fault changed values by little and the mission succeeded, without a
    detector and without --config; or a companion's flight ended before a random time.
    """
    record = run.record
    fault = record.state_fault or record.instruction_fault
    drawn = (record.config["fault"] or record.config["instruction"] or {}).get("at") == "random"
    if fault is not None and fault.reason.startswith(_TOO_SHORT) and drawn and record.programs:
        return [
            "",
            "A random time may fall after the end of the flight; set flight_s in the companion's "
            "file to the length of its flight.",
        ]
    changes = [change for strike in record.strikes for change in strike.changes]
    small = (
        change.before is not None
        and change.after is not None
        and abs(change.after - change.before) <= _SMALL * max(1.0, abs(change.before))
        for change in changes
    )
    if not record.succeeded or record.config["detector"] or not (changes and all(small)):
        return []
    if "config" in given_options():  # the file's fault settings would alter the suggested fault
        return []
    line = ["mavfi", "fly"]
    for name, value in given_options().items():
        if name in _SOURCE | _EITHER | {"inject"}:
            continue
        if isinstance(value, bool):
            line += [spelling(name)] if value else []
        else:
            text = ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
            line += [spelling(name), text]
    return ["", f"This flip is too small to see; try: {shlex.join([*line, *_LARGE])}"]


def _mission_of(path: Path | None) -> MissionConfig:
    """Return the configuration of the mission that the user's options describe.

    Args:
        path: TOML file of a mission, whose values the options override; None starts from the
            defaults.

    Raises:
        ConfigError: the file or an option is not valid.
        UsageError: options contradict each other, or part of an option's value is not valid.
    """
    from mavfi_cli.core.config import load_toml
    from mavfi_cli.spec.mission import MissionConfig

    base = MissionConfig() if path is None else load_toml(path, MissionConfig)
    try:
        return _replaced(base, given_options())
    except FaultSpecError as error:
        raise click.UsageError(str(error)) from None
    except ConfigError as error:  # for an option, the command itself adds its name
        if error.path is not None or spelling(error.key) != error.key:
            raise
        raise click.UsageError(str(error)) from None


def _replaced(base: MissionConfig, given: Given) -> MissionConfig:
    from mavfi_cli.spec.companion import CompanionConfig
    from mavfi_cli.spec.mission import OF_THE_WORLD, OWN_AUTOPILOT

    fault, instruction = _faults(base, given)
    link, companion = given.get("link", base.link), given.get("companion", base.companion)
    land = given.pop("land", base.land or (link is not None and base.link is None))
    if link is not None and companion is None and not given.get("eyes", base.eyes):
        refuse_given(OF_THE_WORLD, "has no effect with --link unless --eyes is given")
    if given.get("autopilot", base.autopilot) == OWN_AUTOPILOT:
        refuse_given({"firmware"}, "needs --autopilot px4 or ardupilot")
    own = {field.name for field in fields(base)} - {"fault", "instruction", "detector"}
    mission = replace(
        base,
        fault=fault,
        instruction=instruction,
        detector=_detector_of(base, given),
        land=land,
        **{name: value for name, value in given.items() if name in own},
    )
    if fault is not None and fault.persistence == "transient" and not fault.killed_node:
        refuse_given({"duration_s"}, "needs --persistence stuck-at or intermittent")
    if fault is not None:
        _refuse_unused_bits(fault)
    if not (instruction or mission.isolate or (fault is not None and fault.killed_node)):
        refuse_given({"node_restart_s"}, _DYING)
    mission.loaded_stack()
    if mission.detector is not None and mission.companion is not None:
        mission.detector.build_for_companion(CompanionConfig.load(mission.companion).mark)
    elif mission.detector is not None:
        mission.detector.build(mission.stack)
    elif fault is not None and fault.attacks_detector:
        raise click.UsageError(f"--inject {fault.target} needs --detector NAME")
    return mission


def _refuse_unused_bits(fault: FaultConfig) -> None:
    """Raise UsageError if an option chooses bits that the fault does not flip, or a bit twice."""
    if fault.effect != "flip":
        refuse_given({"bits", "field", "exact_bits"}, f"has no effect with --effect {fault.effect}")
    if fault.exact_bits:
        refuse_given({"bits", "field"}, "has no effect with --bit, which names the bits")
        if len(set(fault.exact_bits)) < len(fault.exact_bits):
            raise click.UsageError("--bit must not name a bit twice")


def _faults(
    base: MissionConfig, given: Given
) -> tuple[FaultConfig | None, InstructionConfig | None]:
    """Return the source-level and the instruction-level fault of the mission, after checking them.

    A mission has at most one fault, so at least one of the two is None.
    """
    from mavfi_cli.attack.live import mission_strategy
    from mavfi_cli.mission.companion_faults import check_companion_fault
    from mavfi_cli.spec.companion import CompanionConfig
    from mavfi_cli.spec.fault import FaultConfig, InstructionConfig

    if "replay" in given:
        return None, _recorded_fault(Path(given["replay"]), given.get("companion", base.companion))
    source = given.get("level", "source" if base.instruction is None else "instruction") == "source"
    prior = base.fault if source else base.instruction
    target = given.get("inject", None if prior is None else prior.target)
    if target is None:
        refuse_given(_SOURCE | _EITHER | _INSTRUCTION, "needs --inject")
        if not source:
            raise click.UsageError("--level instruction needs --inject NODE")
        return None, None
    own, other = (_SOURCE, _INSTRUCTION) if source else (_INSTRUCTION | {"at"}, _SOURCE - {"at"})
    refuse_given(other, f"needs --level {'instruction' if source else 'source'}")
    values = {name: given[name] for name in (_EITHER | own) & set(given)}
    direction = values.pop("direction", None)
    if "fault_seed" in values:
        values["seed"] = values.pop("fault_seed")
    kind: Any = FaultConfig if source else InstructionConfig
    fault: Any = replace(prior or kind(target=target), target=target, **values)
    if source:
        if direction is not None:
            if fault.wire_target is None:
                raise click.UsageError("--stage needs --inject with a MAVLink message")
            fault = replace(fault, target=f"{direction}.{fault.wire_target[1]}")
        companion = given.get("companion", base.companion)
        if companion is None:
            fault.check()
        else:
            check_companion_fault(fault, CompanionConfig.load(companion))
        return fault, None
    mission_strategy(fault)  # rejects unknown names before the flight
    companion = given.get("companion", base.companion)
    if companion is None:
        refuse_given(_OF_PROGRAM, "needs --companion")
        refuse_given({"at"}, "needs --level source, or --companion")
        fault.node()
    else:
        check_companion_fault(fault, CompanionConfig.load(companion))
    return None, fault


def _recorded_fault(run: Path, companion: str | None) -> InstructionConfig:
    """Return the instruction-level fault that a run of a user's companion recorded.

    Args:
        run: the run folder.
        companion: the user's companion in the new mission; None if it has none.

    Raises:
        RecordError: the run has no record of such a fault.
        UsageError: an option conflicts with --replay, or --companion is missing.
    """
    from mavfi_cli.core.config import structure
    from mavfi_cli.fi.tracer.record import fault_of
    from mavfi_cli.mission.companion_faults import check_companion_fault
    from mavfi_cli.spec.companion import CompanionConfig
    from mavfi_cli.spec.fault import InstructionConfig

    others = _SOURCE | _EITHER | _INSTRUCTION | {"inject", "level"}
    refuse_given(others, "cannot be combined with --replay, which takes it from the record")
    if companion is None:
        raise click.UsageError(
            "--replay needs --companion; to repeat a flight without it, use `mavfi replay`"
        )
    recorded = _record_of(run)
    if recorded["trigger"]:
        fault_of(recorded)  # refuses a damaged record
    fault = structure(recorded.get("request") or {}, InstructionConfig)
    check_companion_fault(fault, CompanionConfig.load(companion))
    return fault


def _record_of(run: Path) -> FaultRecord:
    from mavfi_cli.fi.tracer.record import read
    from mavfi_cli.mission.run_folder import RunFolder

    return read(RunFolder(run).fault)


def _detector_of(base: MissionConfig, given: Given) -> DetectorConfig | None:
    from mavfi_cli.spec.detector import DetectorConfig

    name = given.get("detector", None if base.detector is None else base.detector.name)
    if name is None or name == "none":
        refuse_given(_DETECTOR, "needs --detector NAME")
        return None
    values = {option: given[option] for option in _DETECTOR & set(given)}
    if base.detector is None or base.detector.name != name:
        return DetectorConfig(name=name, **values)
    return replace(base.detector, **values)
