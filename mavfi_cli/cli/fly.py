"""`mavfi fly`: one mission, with live progress, a summary and a run folder."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

if TYPE_CHECKING:
    from mavfi_cli.mission.config import MissionConfig
    from mavfi_cli.mission.detector_config import DetectorConfig
    from mavfi_cli.mission.fault_config import FaultConfig
    from mavfi_cli.mission.instruction_config import InstructionConfig

_FAULT_OPTIONS = (
    "at", "bits", "field", "exact_bits", "effect", "persistence", "duration_s", "period_s",
    "together",
)  # fmt: skip
_INSTRUCTION_OPTIONS = ("sampling", "sites", "roles", "compat", "null")
_DETECTOR_OPTIONS = ("protect", "threshold", "model", "any_stack", "alarms_max", "watch")
_OUTCOMES = ["success", "collision", "no_path", "timeout", "failsafe", "link_lost", "crash", "hang"]


class _Place(click.ParamType[Any]):
    """Three numbers: east, north, up in metres."""

    name = "X,Y,Z"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[float, float, float]:
        """(east, north, up), or a usage error."""
        if isinstance(value, tuple):
            return value
        try:
            x, y, z = (float(part) for part in str(value).split(","))
        except ValueError:
            self.fail(f"{value!r} is not three numbers like 30,40,5", param, ctx)
        return x, y, z


class _Size(click.ParamType[Any]):
    """An image size."""

    name = "WxH"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[int, int]:
        """(columns, rows), or a usage error."""
        if isinstance(value, tuple):
            return value
        try:
            columns, rows = (int(part) for part in str(value).lower().split("x"))
        except ValueError:
            self.fail(f"{value!r} is not a size like 64x48", param, ctx)
        return columns, rows


@click.command()
@click.option("--world", default="dense", show_default=True, metavar="NAME|FILE",
              help="A world, or a TOML file of boxes; `mavfi world list` shows them.")  # fmt: skip
@click.option("--seed", default=3, show_default=True, help="Root seed of everything random.")
@click.option("--world-seed", type=int, help="Seed of the world alone  [that of --seed].")
@click.option("--planner", default="rrtstar", show_default=True,
              help="rrtstar, rrt, rrtconnect, or a plug-in's name.")  # fmt: skip
@click.option("--platform", default="x86", show_default=True,
              metavar="NAME|FILE|measured:FACTOR",
              help="The companion computer whose latencies the flight feels; measured: this "
                   "host's own kernel times, times the factor, with --realtime.")  # fmt: skip
@click.option("--stack", default="mavbench", show_default=True, metavar="NAME|FILE",
              help="How the companion is wired and what it checks; `mavfi stacks` shows "
                   "them.")  # fmt: skip
@click.option("--vehicle", default="solo", show_default=True, metavar="NAME|FILE",
              help="solo, spark, or a TOML profile.")  # fmt: skip
@click.option("--start", type=_Place(),
              help="Where to take off, ENU, m  [the world's own]. See --goal.")  # fmt: skip
@click.option("--goal", type=_Place(),
              help="Where to fly, ENU, m  [the world's own]. A generated world is made round start "
                   "and goal: another place moves its bounds, and towers within 3 m of it are left "
                   "out.")  # fmt: skip
@click.option("--height", "takeoff_height_m", default=5.0, show_default=True,
              help="Take-off height, m.")  # fmt: skip
@click.option("--v-max", "v_max_mps", default=3.0, show_default=True, help="Speed limit, m/s.")
@click.option("--a-max", "a_max_mps2", default=5.0, show_default=True,
              help="Acceleration limit, m/s^2.")  # fmt: skip
@click.option("--tolerance", "goal_tolerance_m", type=float,
              help="How near the goal counts as reached, m  [the stack's own].")  # fmt: skip
@click.option("--time-limit", "time_limit_s", default=300.0, show_default=True,
              help="Simulated seconds after take-off.")  # fmt: skip
@click.option("--camera", type=_Size(), default="64x48", show_default=True,
              help="Depth image size.")  # fmt: skip
@click.option("--realtime", is_flag=True, help="Pace the simulated vehicle by the wall clock.")
@click.option("--link", metavar="URL",
              help="Fly a foreign autopilot: udpin:, udpout:, tcp:, tcpin:, serial:.")  # fmt: skip
@click.option("--land/--no-land", default=None,
              help="Land and disarm at the goal  [only with --link].")  # fmt: skip
@click.option("--inject", metavar="STAGE|STATE|GROUP",
              help="Corrupt a state: perception, planning or control draws one of that stage; "
                   "or name a state or group, as `mavfi states` lists them; or detector, "
                   "detector.threshold ...: what the detector itself keeps; or process.NODE: the "
                   "node's process is killed.")  # fmt: skip
@click.option("--restart", "node_restart_s", default=1.0, show_default=True,
              help="Time until a node that died works again, s; 3600 is never.")  # fmt: skip
@click.option("--at", default="random", show_default=True,
              metavar="random|time=S|tick=N|phase=NAME|foreseen|invocation=N",
              help="When the fault strikes, counted from the companion's taking over.")  # fmt: skip
@click.option("--bits", default=1, show_default=True, help="How many bits are flipped.")
@click.option("--field", default="any", show_default=True,
              help="Of which field: sign, exponent, mantissa, any.")  # fmt: skip
@click.option("--bit", "exact_bits", multiple=True, type=int,
              help="This bit instead of drawn ones. May be repeated.")  # fmt: skip
@click.option("--effect", default="flip", show_default=True, help="flip, zero, random.")
@click.option("--persistence", default="transient", show_default=True,
              help="transient, stuck-at, intermittent.")  # fmt: skip
@click.option("--duration", "duration_s", type=float,
              help="How long a stuck-at or intermittent fault lasts, s  [to the end].")  # fmt: skip
@click.option("--period", "period_s", default=1.0, show_default=True,
              help="Time between the strikes of an intermittent fault, s.")  # fmt: skip
@click.option("--all-components", "together", is_flag=True,
              help="Strike all states of the group, each with its own bits.")  # fmt: skip
@click.option("--fault-seed", default=1, show_default=True,
              help="Seed of all that is drawn for the fault.")  # fmt: skip
@click.option("--level", type=click.Choice(["source", "instruction"]), default="source",
              show_default=True,
              help="Corrupt a state between kernels, or an operand of one machine instruction of "
                   "a kernel: --inject point_cloud, octomap, collision_check, planner, control, "
                   "perception or planning.")  # fmt: skip
@click.option("--sampling", default="instruction-uniform", show_default=True,
              help="Instruction level: from which population the moment is drawn.")  # fmt: skip
@click.option("--site", "sites", multiple=True,
              help="Instruction level: general, flags, vector, x87, mask, instruction-pointer, "
                   "opcode, memory. May be repeated.")  # fmt: skip
@click.option("--role", "roles", multiple=True,
              help="Instruction level: source or destination  [both].")  # fmt: skip
@click.option("--compat", help="Instruction level: registers and bits as rosfi-2021 chose them.")
@click.option("--null-injection", "null", is_flag=True,
              help="Instruction level: do everything but the flip.")  # fmt: skip
@click.option("--detector", metavar="NAME",
              help="Watch the states and recover: gad, aad, range, l2, or a plug-in's name "
                   "[none].")  # fmt: skip
@click.option("--protect", default="perception,planning,control", show_default=True,
              metavar="STAGE,...", help="Which stages the detector watches.")  # fmt: skip
@click.option("--threshold", type=float,
              help="Of the detector: alarm above this score; for gad the number of sigmas "
                   "[the model's own].")  # fmt: skip
@click.option("--model", type=click.Path(exists=True, dir_okay=False),
              help="A model file of the detector's  [the one shipped for the stack].")  # fmt: skip
@click.option("--any-stack-model", "any_stack", is_flag=True,
              help="Let the detector fly with a model of another stack; without --model that of "
                   "the stack which this one is based on.")  # fmt: skip
@click.option("--watch", default="paper", show_default=True, metavar="paper|extended",
              help="Which states the detector's gate watches: the paper's 13, or also collision "
                   "and the sequence numbers of plans.")  # fmt: skip
@click.option("--alarms-max", default=5, show_default=True,
              help="The alarm in a row of one stage at which the vehicle holds and plans "
                   "anew.")  # fmt: skip
@click.option("--isolate", multiple=True, metavar="NODE",
              help="Let a node work in its own process: point_cloud, octomap, collision_check, "
                   "planner, control. May be repeated; the record stays the same.")  # fmt: skip
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=Path("runs"),
              show_default=True, help="Where the run folder goes.")  # fmt: skip
@click.option("--picture/--no-picture", default=True, help="Draw flight.svg.", show_default=True)
@click.option("--expect", type=click.Choice(_OUTCOMES),
              help="Exit with 1 unless the mission ends like this.")  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print result.json instead of the summary.")
@click.option("--quiet", is_flag=True, help="No progress on stderr.")
def fly(
    out: Path, picture: bool, expect: str | None, as_json: bool, quiet: bool, **options: Any
) -> None:
    """Fly one mission from take-off to the goal, through obstacles that nobody told it about.

    A mission that fails is a result: the exit code is 0 unless --expect asks otherwise.
    """
    from mavfi_cli.cli.progress import progress_view
    from mavfi_cli.mission.record.run_folder import load_run
    from mavfi_cli.mission.run import fly_mission
    from mavfi_cli.report.summary import outcome_line, summary_lines
    from mavfi_cli.report.top_view import write_top_view

    config = _config(options)
    with progress_view(config, quiet=quiet) as view:
        folder = fly_mission(config, out, view)
    run = load_run(folder.path)
    if picture:
        write_top_view(run, folder.picture)
    if as_json:
        click.echo(json.dumps(run.result, indent=2, sort_keys=True))
    else:
        click.echo("\n".join(summary_lines(run.result)))
        click.echo(
            f"\nRun folder  {folder.path}" + (f"  (see {folder.picture.name})" if picture else "")
        )
    if run.result["outcome"] == "interrupted":
        raise click.exceptions.Exit(130)
    if expect is not None and run.result["outcome"] != expect:
        click.echo(f"error: expected {expect}, got {outcome_line(run.result)}", err=True)
        raise click.exceptions.Exit(1)


def _config(options: dict[str, Any]) -> MissionConfig:
    from mavfi_cli.mission.config import MissionConfig
    from mavfi_cli.mission.platform import measured_factor

    if options["link"] is not None and options["goal"] is None:
        raise click.UsageError("--link needs --goal X,Y,Z (ENU, m, from its local origin)")
    if measured_factor(options["platform"]) is not None and not options["realtime"]:
        raise click.UsageError(f"--platform {options['platform']} needs --realtime")
    fault, instruction = _fault(options)
    detector = _detector(options)
    columns, rows = options.pop("camera")
    land = options.pop("land")
    return MissionConfig(
        camera_columns=columns,
        camera_rows=rows,
        fault=fault,
        instruction=instruction,
        detector=detector,
        land=options["link"] is not None if land is None else land,
        **options,
    )


def _fault(options: dict[str, Any]) -> tuple[FaultConfig | None, InstructionConfig | None]:
    """The fault that is asked for, taken out of the options; says now what is wrong with it."""
    from mavfi_cli.mission.fault_config import FaultConfig
    from mavfi_cli.mission.instruction_config import InstructionConfig

    asked = {name: options.pop(name) for name in _FAULT_OPTIONS}
    native = {name: options.pop(name) for name in _INSTRUCTION_OPTIONS}
    target, seed, level = (options.pop(name) for name in ("inject", "fault_seed", "level"))
    _refuse_unused(target, level)
    if target is None:
        if level == "instruction":
            raise click.UsageError("--level instruction needs --inject NODE")
        return None, None
    exact = asked.pop("exact_bits") or None
    if level == "source":
        fault = FaultConfig(target=target, seed=seed, exact_bits=exact, **asked)
        fault.check()
        if fault.attacks_detector and options["detector"] in (None, "none"):
            raise click.UsageError(f"--inject {target} needs --detector NAME")
        return fault, None
    instruction = InstructionConfig(
        target=target, seed=seed, field=asked["field"], bits=asked["bits"], **native
    )
    instruction.strategy()
    instruction.node()
    return None, instruction


def _detector(options: dict[str, Any]) -> DetectorConfig | None:
    """The detector that is asked for, taken out of the options; says now what is wrong with it."""
    from mavfi_cli.mission.detector_config import DetectorConfig, detector_of

    name = options.pop("detector")
    asked = {option: options.pop(option) for option in _DETECTOR_OPTIONS}
    if name is None or name == "none":
        _refuse_given(set(_DETECTOR_OPTIONS), "--detector NAME")
        return None
    stages = tuple(part.strip() for part in asked.pop("protect").split(",") if part.strip())
    detector = DetectorConfig(name=name, protect=stages, **asked)
    detector_of(detector, options["stack"])
    return detector


def _refuse_unused(target: str | None, level: str) -> None:
    """An option that would do nothing is a mistake: exit code 2."""
    source_only = set(_FAULT_OPTIONS) - {"bits", "field"}
    if target is None:
        unused, needs = {*_FAULT_OPTIONS, *_INSTRUCTION_OPTIONS, "fault_seed"}, "--inject"
    elif level == "source":
        unused, needs = set(_INSTRUCTION_OPTIONS), "--level instruction"
    else:
        unused, needs = source_only, "--level source"
    _refuse_given(unused, needs)


def _refuse_given(unused: set[str], needs: str) -> None:
    context = click.get_current_context()
    for option in context.command.params:
        given = context.get_parameter_source(str(option.name))
        if option.name in unused and given is ParameterSource.COMMANDLINE:
            raise click.UsageError(f"{option.opts[0]} needs {needs}")
