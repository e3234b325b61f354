"""Defines commands whose options are grouped: the help shows one section per group."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import fields
from functools import partial
from typing import Any, TypeVar

import click
from click.core import ParameterSource

from mavfi_cli.core.errors import ConfigError, MavfiError, PlaceError


class _GroupedOption(click.Option):
    """An option that the help shows in the section of its group."""

    def __init__(self, *args: Any, group: str, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.group = group


Given = dict[str, Any]  # the values of options by parameter name
Decorated = TypeVar("Decorated", bound=Callable[..., Any] | click.Command)


def section(title: str) -> Callable[..., Callable[[Decorated], Decorated]]:
    """Return a `click.option` whose options appear in this section and show their defaults."""
    return partial(click.option, cls=_GroupedOption, group=title, show_default=True)


option = section("Options")  # for commands without sections


class GroupedCommand(click.Command):
    """A command whose errors name the option at fault and whose help groups the options."""

    def invoke(self, ctx: click.Context) -> Any:
        """Call the command; turn an error in an option's value into a usage error naming it."""
        if ctx.params.get("as_json") and ctx.params.get("as_csv"):
            raise click.UsageError("--json cannot be combined with --csv")
        try:
            return super().invoke(ctx)
        except MavfiError as error:
            option, problem = _blamed(error)
            if not option.startswith("--"):
                raise
            raise click.UsageError(f"{option}: {problem}") from None

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write one section per group, in the order of declaration."""
        sections: dict[str, list[tuple[str, str]]] = {}
        params = self.get_params(ctx)
        (*_, rest) = ("Options", *(p.group for p in params if isinstance(p, _GroupedOption)))
        for param in params:
            record = None if isinstance(param, click.Argument) else param.get_help_record(ctx)
            if record is not None:
                sections.setdefault(getattr(param, "group", rest), []).append(record)
        for title, records in sections.items():
            with formatter.section(title):
                formatter.write_dl(records)


class GroupOfCommands(click.Group):
    """A group whose help shows the whole first sentence of each command."""

    command_class = GroupedCommand

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of commands."""
        with formatter.section("Commands"):
            formatter.write_dl(
                [
                    (name, command.get_short_help_str(limit=1000))
                    for name, command in sorted(self.commands.items())
                ]
            )


def _blamed(error: MavfiError) -> tuple[str, str]:
    """Return the option or argument that caused an error, and the problem; or "", ""."""
    if isinstance(error, ConfigError) and error.key and not error.path:
        return spelling(error.key), error.problem
    if isinstance(error, PlaceError):  # it names the world, which is not at fault
        return "", ""
    for name, value in given_options().items() if error.exit_code == 2 else ():
        texts = value if isinstance(value, tuple) else (value,)
        words = (
            word for text in texts if isinstance(text, str) for word in (text, *names_in(text))
        )
        if any(repr(word) in str(error) for word in words):
            return spelling(name), str(error)
    return "", ""


def given_options() -> Given:
    """Return the options that the user gave to the current command, by parameter name."""
    context = click.get_current_context()
    return {
        name: value
        for name, value in context.params.items()
        if context.get_parameter_source(name) is ParameterSource.COMMANDLINE
    }


def given_fields(kind: type, **others: Any) -> Given:
    """Return those options given by the user that are fields of a dataclass.

    Args:
        kind: the dataclass, such as a plan.
        others: further fields, which take precedence.
    """
    known = {field.name for field in fields(kind)}
    return {name: own for name, own in given_options().items() if name in known} | others


def spelling(name: str) -> str:
    """Return the current command's option for a parameter, such as `--v-max`; else the name."""
    for param in click.get_current_context().command.params:
        if param.name == name or f"--{name}" in param.opts:
            return param.opts[0]
    return name


def refuse_given(names: Collection[str], why: str) -> None:
    """Raise UsageError if the user gave one of these options. The message is option and `why`."""
    for name in given_options():
        if name in names:
            raise click.UsageError(f"{spelling(name)} {why}")


def names_in(text: str) -> tuple[str, ...]:
    """Return the names in a comma-separated list."""
    return tuple(name.strip() for name in text.split(",") if name.strip())
