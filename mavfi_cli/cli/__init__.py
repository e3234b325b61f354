"""The command line: one thin module per command, imported when the command is called."""

from __future__ import annotations

import contextlib
import importlib
import os
import shlex
import signal
import subprocess
import sys
from typing import NoReturn

import click
from click.shell_completion import CompletionItem

from mavfi_cli.core.compiled import choose_caches
from mavfi_cli.core.errors import UnknownName
from mavfi_cli.core.terminal import exit_code, leave

# Command -> its module and a summary, so that the help page need not import the modules. A
# vehicle-side command replaces this process.
_COMMANDS = {
    "fly": ("mavfi_cli.cli.fly", "Fly one mission: live progress, summary, run folder."),
    "companion": ("mavfi_cli.cli.companion", "Fly a vehicle as a program, for fly --companion."),
    "sitl": ("sitl", "Run the simulated vehicle alone, for any MAVLink client."),
    "world": ("sitl.world", "List, make, check and draw worlds."),
    "replay": ("mavfi_cli.cli.runs", "Repeat a run and compare the records."),
    "kernels": ("mavfi_cli.cli.kernels", "Flip bits in isolated kernels, one fault per run."),
    "train": ("mavfi_cli.cli.train", "Fly error-free missions and fit the detectors."),
    "gate": ("mavfi_cli.cli.gate", "Guard the link between a companion and an autopilot."),
    "detect": ("mavfi_cli.cli.detect", "List the detectors and evaluate them."),
    "campaign": ("mavfi_cli.cli.campaign", "Plan, run and summarise thousands of missions."),
    "reproduce": ("mavfi_cli.cli.paper", "Fly every experiment of the paper."),
    "report": ("mavfi_cli.cli.paper", "Write one page: the paper's claims beside flown missions."),
    "compare": ("mavfi_cli.cli.compare", "Fly the same missions on several platforms."),
    "vpm": ("mavfi_cli.cli.vpm", "Model the cost of DMR and TMR in speed, time and energy."),
    "platforms": ("mavfi_cli.cli.inventory", "List the compute platforms and their latencies."),
    "stacks": ("mavfi_cli.cli.inventory", "List and compare the stacks of the companion."),
    "states": ("mavfi_cli.cli.inventory", "List the states that can be corrupted."),
    "show": ("mavfi_cli.cli.runs", "Summarise a recorded run."),
    "view": ("mavfi_cli.cli.view", "Look at a recorded run in rerun or Foxglove."),
    "doctor": ("mavfi_cli.cli.inventory", "Test what works on this machine."),
}

_terminated: list[bool] = []  # by SIGTERM


class _LazyGroup(click.Group):
    """The group of all commands. It imports a command's module when the command is first needed."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the commands' names in the order of the help page."""
        return list(_COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import the module of a command and return the command, or None for an unknown name."""
        if cmd_name not in _COMMANDS:
            return None
        module = _COMMANDS[cmd_name][0]
        if module.startswith("sitl"):
            return _vehicle_side(cmd_name, module)
        command: click.Command = getattr(importlib.import_module(module), cmd_name)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of commands from a table, because importing every module would be slow."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, text) for name, (_, text) in _COMMANDS.items()])

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Complete command names from a table, because importing every module would be slow."""
        items = [
            CompletionItem(name, help=text)
            for name, (_, text) in _COMMANDS.items()
            if name.startswith(incomplete)
        ]
        return items or click.Command.shell_complete(self, ctx, incomplete)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command as click does, but suggest the nearest name if it does not exist."""
        if args and args[0] not in _COMMANDS and not args[0].startswith("-"):
            ctx.fail(str(UnknownName("command", args[0], _COMMANDS)))
        return super().resolve_command(ctx, args)


class _VehicleSide(click.Command):
    """A command of the simulated vehicle, which runs as a separate program."""

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Ask the program for completions, unless it is `mavfi sitl`, which would start flying."""
        from mavfi_cli.core.processes import PYTHON

        if self.name != "world":
            return []
        words = [self.name, *ctx.params["arguments"]]
        request = {
            "_MAVFI WORLD_COMPLETE": "bash_complete",
            "COMP_WORDS": shlex.join([*words, incomplete]),
            "COMP_CWORD": str(len(words)),
        }
        line = [*PYTHON, "-m", _COMMANDS[self.name][0]]
        done = subprocess.run(line, env=os.environ | request, capture_output=True, text=True)
        items = (row.partition(",") for row in done.stdout.splitlines() if row)
        return [CompletionItem(value, type=kind) for kind, _, value in items]


def _vehicle_side(name: str, module: str) -> click.Command:
    """Return a command that replaces this process with `python -m MODULE`.

    All arguments are passed on.
    """

    def become(arguments: tuple[str, ...]) -> None:
        from mavfi_cli.core.processes import PYTHON

        sys.stdout.flush()
        sys.stderr.flush()
        os.execv(sys.executable, [*PYTHON, "-m", module, *arguments])

    arguments = click.Argument(
        ["arguments"], nargs=-1, type=click.UNPROCESSED,
        shell_complete=lambda ctx, _param, incomplete: ctx.command.shell_complete(ctx, incomplete),
    )  # fmt: skip
    settings = {"ignore_unknown_options": True, "help_option_names": []}
    return _VehicleSide(name, settings, become, [arguments], add_help_option=False)


@click.group(cls=_LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="mavfi", prog_name="mavfi")
def cli() -> None:
    """Find out what a bit flip does to a flying robot, and what surviving it costs."""


def main() -> NoReturn:
    """Run the command line and end the process with the command's exit code.

    An error prints one line and exits with code 1, a usage error with code 2. An unknown name is a
    usage error.
    """
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(name, "1")  # our arrays are small; threads would only slow the start
    choose_caches()
    with contextlib.suppress(ValueError):  # not the main thread
        signal.signal(signal.SIGTERM, _interrupt)
    code = exit_code(lambda: cli.main(prog_name="mavfi", standalone_mode=False))
    leave(128 + signal.SIGTERM if _terminated else code)


def _interrupt(*_: object) -> NoReturn:
    """Handle SIGTERM like Ctrl-C, so that no process and no temporary folder is left behind."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    _terminated.append(True)
    raise KeyboardInterrupt
