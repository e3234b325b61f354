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
    """An option that the help page lists in the section of its group.

    Args:
        group: title of the section.
    """

    def __init__(self, *args: Any, group: str, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.group = group


Given = dict[str, Any]  # the values of options by parameter name
Decorated = TypeVar("Decorated", bound=Callable[..., Any] | click.Command)


def section(title: str) -> Callable[..., Callable[[Decorated], Decorated]]:
    """Return a decorator like `click.option` whose options are listed in a section of the help.

    The help shows the defaults of these options.
    """
    return partial(click.option, cls=_GroupedOption, group=title, show_default=True)


option = section("Options")  # for commands without sections


class GroupedCommand(click.Command):
    """A command whose help lists options in sections and whose errors name the option at fault."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command. Convert an error about an option's value into a usage error.

        The message of the usage error names the option.
        """
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
        """Write one section per group of options, in the order in which they are declared."""
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
        """Write the list of commands in alphabetical order, each with its first sentence."""
        with formatter.section("Commands"):
            formatter.write_dl(
                [
                    (name, command.get_short_help_str(limit=1000))
                    for name, command in sorted(self.commands.items())
                ]
            )


def _blamed(error: MavfiError) -> tuple[str, str]:
    """Return the option or argument that caused an error and the problem, or two empty strings.

    The strings are empty if the cause is unknown.
    """
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
    """Return the values of the options that the user gave to the current command.

    They are keyed by parameter name. Options with default values are omitted.
    """
    context = click.get_current_context()
    return {
        name: value
        for name, value in context.params.items()
        if context.get_parameter_source(name) is ParameterSource.COMMANDLINE
    }


def given_fields(kind: type, **others: Any) -> Given:
    """Return the values of the options that the user gave and that are fields of a dataclass.

    They are keyed by field name, as arguments for the dataclass.

    Args:
        kind: the dataclass, such as a plan.
        others: values of further fields, which replace the user's.
    """
    known = {field.name for field in fields(kind)}
    return {name: own for name, own in given_options().items() if name in known} | others


def spelling(name: str) -> str:
    """Return how the user writes a parameter, such as `--v-max`, or the name itself if unknown.

    The parameters are those of the current command.
    """
    for param in click.get_current_context().command.params:
        if param.name == name or f"--{name}" in param.opts:
            return param.opts[0]
    return name


def refuse_given(names: Collection[str], why: str) -> None:
    """Raise an error if the user gave one of these options.

    Args:
        names: parameter names of the options.
        why: the end of the message, which begins with the option.

    Raises:
        click.UsageError: one of the options was given.
    """
    for name in given_options():
        if name in names:
            raise click.UsageError(f"{spelling(name)} {why}")


def names_in(text: str) -> tuple[str, ...]:
    """Split a comma-separated list into names, without surrounding spaces and empty names."""
    return tuple(name.strip() for name in text.split(",") if name.strip())
