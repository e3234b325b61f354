"""`mavfi kernels`: inject one fault per run into an isolated kernel and compare its output."""

from __future__ import annotations

import contextlib
import json
import os
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mavfi_cli.cli import types
from mavfi_cli.cli.grouped import Given, GroupedCommand, given_options, refuse_given, section
from mavfi_cli.core.errors import ConfigError
from mavfi_cli.core.files import ScratchFolder
from mavfi_cli.core.option_types import Number
from mavfi_cli.core.terminal import echo, note

if TYPE_CHECKING:
    from mavfi_cli.attack.campaign import Plan
    from mavfi_cli.attack.program import ProgramTarget
    from mavfi_cli.attack.target import AttackTarget

_OF_PROGRAM = (
    "args", "compare", "ignore_lines", "stdin_file", "folder", "env", "scope", "function",
)  # fmt: skip


_WIDEST = 4096  # bits of the longest operand, that of fxsave
_target = section("Kernels")
_native = section("Native program")
_fault = section("Fault")
_runs = section("Runs")
_output = section("Output")


@click.command(cls=GroupedCommand)
@_target("--kernel", multiple=True, type=types.KERNEL, metavar="NAME",
         help="Kernel to attack: point_cloud, octomap, collision_check, rrt, rrtconnect, rrtstar, "
              "control, or a Python file with your own kernel. May be repeated  "
              "[all].")  # fmt: skip
@_target("--world", type=types.WORLD, default="dense", metavar="NAME|FILE",
         help="World of the golden run that supplies the kernels' inputs.")  # fmt: skip
@_target("--world-seed", default=3, type=types.SEED, help="Seed of that golden run.")
@_native("--program", help="Native program to attack instead of the kernels.")
@_native("--args", help="Arguments of the program, quoted as in a shell.")
@_native("--stdin", "stdin_file", metavar="FILE",
         type=click.Path(exists=True, dir_okay=False, path_type=Path),
         help="Standard input of the program  [none].")  # fmt: skip
@_native("--compare", multiple=True, metavar="OUTPUT",
         help="Output to compare: stdout, or file:PATH for a file that the program writes. PATH is "
              "relative to the scratch folder in which the program then runs. May be repeated  "
              "[stdout].")  # fmt: skip
@_native("--ignore-lines", multiple=True, metavar="REGEX",
         help="Do not compare lines that contain a match. May be repeated.")  # fmt: skip
@_native("--folder", type=click.Path(exists=True, file_okay=False, path_type=Path),
         help="Folder of which each run gets a copy to work in  [an empty folder].")  # fmt: skip
@_native("--env", multiple=True, metavar="NAME=VALUE",
         help="Environment variable of the program. May be repeated.")  # fmt: skip
@_native("--memory", default=2.0, metavar="GB", type=types.ABOVE_ZERO,
         help="Memory limit of the program.")  # fmt: skip
@_native("--scope", multiple=True, help="Shared object to attack. May be repeated.")
@_native("--function", help="Attack only code that executes during calls of this function.")
@_fault("--sampling", default="instruction-uniform", type=types.SAMPLING,
        help="Sampling rule: instruction-uniform, cpu-time or wall-clock.")  # fmt: skip
@_fault("--site", multiple=True, type=types.SITE,
        help="Kind of operand: general, flags, vector, x87, mask, instruction-pointer, opcode, "
             "memory. May be repeated  [the first five: registers].")  # fmt: skip
@_fault("--role", multiple=True, type=types.ROLE,
        help="Role of the operand: source or destination  [both].")  # fmt: skip
@_fault("--field", default="any", type=types.FIELD,
        help="Field of the bits: sign, exponent, mantissa or any.")  # fmt: skip
@_fault("--bits", default=1, type=click.IntRange(1, _WIDEST), help="Number of bits to flip.")
@_fault("--seed", default=1, type=types.SEED, help="Seed of the faults.")
@_fault("--compat", type=types.COMPAT, metavar="INJECTOR",
        help="Follow the rules of another injector: pinfi, pinfi-bugs, rosfi-2021.")  # fmt: skip
@_fault("--null", is_flag=True, help="Do everything except the flip.")
@_runs("--runs", default=1000, type=types.MISSIONS,
       help="Runs per kernel, or of the program. Each run has one fault.")  # fmt: skip
@_runs("--jobs", default=1, type=types.JOBS,
       help="Number of parallel runs. It does not change the results.")  # fmt: skip
@_runs("--tolerance", show_default=False, default=0.0, type=Number(0.0, 1.0e6),
       help="Largest relative error that counts as benign.")  # fmt: skip
@_runs("--replay", type=click.Path(path_type=Path, file_okay=False),
       help="Repeat the recorded runs in this folder and compare them. --kernel selects kernels, "
            "--runs limits the runs of each. For runs of a program, give the options of the "
            "program again.")  # fmt: skip
@_output("--out", type=types.OUT,
         help="Folder for records, JSON, CSV and plot. Recorded runs are not "
              "repeated.")  # fmt: skip
@_output("--json", "as_json", is_flag=True, help="Print the summary as JSON.")
def kernels(**options: Any) -> None:
    """Inject one fault per run into an isolated kernel and compare its output.

    Attacks the kernels of the companion, or any native program with --program.

    Outcomes: benign, crash, hang, SDC (silent data corruption), not injected.
    """
    if options["compat"] is not None:
        chosen = ("sampling", "site", "role", "field", "bits")
        refuse_given(chosen, "cannot be combined with --compat, which sets it")
    if options["replay"] is not None:
        shared = ("replay", "kernel", "runs", "program", "tolerance", "memory", *_OF_PROGRAM)
        others = [name for name in options if name not in shared]
        refuse_given(others, "cannot be combined with --replay, which takes it from the record")
        if options["program"] is None:
            refuse_given(("tolerance", "memory", *_OF_PROGRAM), "needs --program")
        program = None if options["program"] is None else _program(options)
        limit = given_options().get("runs", 0)
        if not _replay_folder(options["replay"], options["kernel"], limit, program):
            raise click.exceptions.Exit(1)
    elif options["program"] is not None:
        refuse_given(("kernel", "world", "world_seed"), "cannot be combined with --program")
        _attack(options)
    else:
        refuse_given(("memory", *_OF_PROGRAM), "needs --program")
        _attack(options)


def _plan(options: Given) -> Plan:
    from mavfi_cli.attack.campaign import Plan
    from mavfi_cli.fi.tracer.fault import FaultModel

    plan = Plan(
        **{name: options[name] for name in ("runs", "seed", "compat", "null")},
        rule=options["sampling"],
        model=FaultModel.named(
            sites=options["site"],
            roles=options["role"],
            field=options["field"],
            bits=options["bits"],
        ),
    )
    plan.strategy()  # reports errors before any run
    return plan


def _attack(options: Given) -> None:
    from mavfi_cli.attack.campaign import run_campaign
    from mavfi_cli.cli.progress import runs_view
    from mavfi_cli.report.attacks import save_runs, summarise

    plan, out = _plan(options), options["out"]
    targets: Sequence[AttackTarget]
    with contextlib.ExitStack() as leaving:
        if options["program"] is not None:
            folder, targets = out, [_program(options)]
        else:
            folder = out or leaving.enter_context(ScratchFolder("kernels"))
            targets = _kernels(options, folder)
        with runs_view([target.name for target in targets], plan.runs) as view:
            campaign = run_campaign(
                plan,
                targets,
                jobs=options["jobs"],
                folder=folder,
                progress=view.show,
                stage=view.stage,
                notice=lambda text: view.note(f"warning: {text}"),
            )
        summary = summarise(plan, campaign)
        if out is not None:
            files = ", ".join((*save_runs(out, summary, campaign), "runs.jsonl"))
    if options["as_json"]:
        echo(json.dumps(summary.as_dict(), indent=2))
        return
    echo(f"{summary.text()}\n")
    if out is not None:
        echo(f"Files  {out}: {files}")
    else:
        echo("Nothing is saved; --out FOLDER keeps records, tables and plots.")


def _kernels(options: Given, folder: Path) -> Sequence[AttackTarget]:
    from mavfi_cli.attack.kernels.catalogue import select
    from mavfi_cli.mission.kernel_inputs import kernel_flight, kernel_targets

    kernels = select(options["kernel"])
    config = kernel_flight(options["world"], options["world_seed"])
    note(f"inputs: world {config.world}, seed {config.seed}")
    return kernel_targets(kernels, config, folder, options["tolerance"])


def _program(options: Given) -> ProgramTarget:
    from mavfi_cli.attack.comparison import OutputComparison
    from mavfi_cli.attack.program import ProgramTarget
    from mavfi_cli.attack.work_folder import copied_arguments
    from mavfi_cli.fi.tracer.spawn import Program

    comparison = OutputComparison.of(
        options["compare"], tolerance=options["tolerance"], ignored=options["ignore_lines"]
    )
    try:
        arguments = shlex.split(options["args"] or "")
    except ValueError as error:
        raise ConfigError(str(error), key="args") from None
    folder = None if options["folder"] is None else options["folder"].resolve()
    arguments, files = copied_arguments(arguments, Path.cwd(), folder)
    command = Program.of(
        [options["program"], *arguments],
        variables=dict(map(_variable, options["env"])),
        stdin=(options["stdin_file"] or Path(os.devnull)).resolve(),
        memory_bytes=round(options["memory"] * (1 << 30)),
    )
    return ProgramTarget(
        command=command,
        comparison=comparison,
        folder=folder,
        files=files,
        objects=tuple(options["scope"]),
        function=options["function"],
    )


def _variable(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not name or not equals:
        raise ConfigError(f"must be NAME=VALUE, got {text!r}", key="env")
    return name, value


def _replay_folder(
    folder: Path, kernels: tuple[str, ...], runs: int, program: ProgramTarget | None
) -> bool:
    """Repeat the runs recorded in a folder and print those that differ.

    Return True if all repeated runs are identical to the recorded ones.

    Args:
        kernels: kernels whose runs are repeated; empty selects all built-in kernels.
        runs: largest number of runs of each kernel; 0 repeats all.
        program: the program whose runs are repeated, if they are not those of kernels.
    """
    from mavfi_cli.attack.campaign import replay_runs

    equal = total = 0
    for result in replay_runs(folder, kernels, runs, program):
        total += 1
        equal += not result.differs
        if result.differs:
            echo(f"{result.target} {result.run}: differs in {', '.join(result.differs)}")
    echo(f"{equal} of {total} replays identical")
    return equal == total
