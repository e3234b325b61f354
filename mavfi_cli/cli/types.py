"""Types of command-line options: bounded numbers, names that the shell completes, run folders."""

from __future__ import annotations

import importlib
import itertools
import json
import subprocess
from collections.abc import Callable, Iterable, Iterator
from enum import EnumType
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

from mavfi_cli.cli.grouped import names_in
from mavfi_cli.core.compiled import PACKAGE
from mavfi_cli.core.option_types import Number, OutFolder, Place

# Numbers ------------------------------------------------------------------------------------------


JOBS = click.IntRange(1, 1024)
MISSIONS = click.IntRange(1, 1_000_000)  # flights or runs; also the limit of a campaign
SEED = click.IntRange(0, 2**31 - 1)
FIRST_SEED = click.IntRange(0, 2**31 - 1_000_001)  # each further mission adds 1
BITS, BIT = click.IntRange(1, 64), click.IntRange(0, 63)  # of a state
ABOVE_ZERO = Number(min=1.0e-6, max=1.0e6)
CONFIDENCE = Number(0.0, 1.0, min_open=True, max_open=True)
SHARE, SCALE = Number(0.0, 1.0), Number(0.0, 1000.0, min_open=True)
NUMBER = click.IntRange(0, MISSIONS.max)  # of a mission in its campaign
UPSETS = Number(0.0, 1.0e12)
RESTART = Number(0.0, 3600.0, words={"never": 3600.0})  # s, until a dead node works again
PLACE = Place()

# Names --------------------------------------------------------------------------------------------


Names = str | Callable[[click.Context], Iterable[str]]


class Name(click.ParamType[Any]):
    """The type of an option that takes a name, which the shell can complete.

    Unknown names are accepted here and rejected by the command.

    Args:
        names: Sources of the known names: `MODULE:ATTRIBUTE`, or a function that gets click's
            context with the options given so far.
        several: Whether the option takes several names, separated by commas. Its value is then a
            tuple.
        files: Whether the option takes a path in place of a name, too.
    """

    name = "text"

    def __init__(self, *names: Names, several: bool = False, files: bool = False) -> None:
        self._names, self._several, self._files = names, several, files

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        """Return the name unchanged, or a tuple of names if the option takes several."""
        return names_in(value) if self._several and isinstance(value, str) else value

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        """Return the known names that start with the typed text.

        If no name does and the option takes files, let the shell complete a path.
        """
        typed, comma, begun = incomplete.rpartition(",") if self._several else ("", "", incomplete)
        known = (_loaded(own) if isinstance(own, str) else own(ctx) for own in self._names)
        matches = [
            CompletionItem(f"{typed}{comma}{name}")
            for name in dict.fromkeys(itertools.chain.from_iterable(known))
            if name.startswith(begun) and name not in typed.split(",")
        ]
        return matches or ([CompletionItem(incomplete, type="file")] if self._files else [])


def _loaded(place: str) -> Iterable[str]:
    """Import the object at `MODULE:ATTRIBUTE` and return the names that it contains.

    The object may be an enumeration, whose values are the names; an object with an attribute
    `names`, such as shipped files or plug-ins; or a container of names.
    """
    module, _, attribute = place.partition(":")
    container: Any = getattr(importlib.import_module(module), attribute)
    if isinstance(container, EnumType):
        members: Any = container
        return [str(member.value) for member in members]
    return list(getattr(container, "names", container))


def _worlds(_ctx: click.Context) -> Iterable[str]:
    """Return the names of the worlds by running `sitl.world`.

    It is not imported, because the companion's side must not depend on the vehicle's side.
    """
    from mavfi_cli.core.processes import PYTHON

    line = [*PYTHON, "-m", "sitl.world", "list", "--json"]
    listed = subprocess.run(line, capture_output=True, check=True).stdout
    return [row["name"] for row in json.loads(listed)]


def _vehicles(_ctx: click.Context) -> Iterable[str]:
    from mavfi_cli.core.config import Shipped

    return Shipped("vehicle", PACKAGE.parent / "sitl" / "vehicle" / "profiles").names


def _targets(ctx: click.Context) -> Iterable[str]:
    from mavfi_cli.spec.fault import target_names

    return target_names(instruction=ctx.params.get("level") == "instruction")


def _fixed(*names: str) -> Callable[[click.Context], Iterable[str]]:
    return lambda _ctx: names


_STAGES = "mavfi_cli.core.types:Stage"
_DETECTORS = _fixed("none"), "mavfi_cli.detect.base:PLUG_INS"
WORLD, VEHICLE = Name(_worlds, files=True), Name(_vehicles, files=True)
MODEL_VEHICLE = Name("mavfi_cli.vpm.model:VEHICLES", files=True)
BOARD = Name("mavfi_cli.vpm.model:BOARDS", files=True)
PLATFORM = Name("mavfi_cli.spec.platform:PLATFORMS", files=True)
STACK = Name("mavfi_cli.spec.stack:STACKS", files=True)
PLANNER = Name("mavfi_cli.autonomy.planners:PLANNERS")
AUTOPILOT = Name(_fixed("ours"), "mavfi_cli.spec.mission:FIRMWARE")
DETECTOR, DETECTORS = Name(*_DETECTORS), Name(*_DETECTORS, several=True)
STAGES, WATCH = Name(_STAGES, several=True), Name("mavfi_cli.spec.detector:WATCHES")
TARGET, TARGETS = Name(_targets), Name(_fixed("none"), _targets, several=True)
FIELD = Name("mavfi_cli.fi.bits:Field")
FIELDS = Name("mavfi_cli.fi.bits:Field", _fixed("integer"), several=True)
EFFECT = Name("mavfi_cli.fi.fault:Effect")
PERSISTENCE = Name("mavfi_cli.fi.fault:Persistence")
SITE, ROLE = Name("mavfi_cli.fi.tracer.fault:Site"), Name("mavfi_cli.fi.tracer.fault:Role")
SAMPLING = Name("mavfi_cli.fi.tracer.fault:Rule")
COMPAT = Name("mavfi_cli.fi.tracer.fault:COMPAT")
KERNEL = Name("mavfi_cli.attack.kernels.catalogue:KERNELS", files=True)
ITEM = Name("mavfi_cli.paper.items:BY_NAME")
CAMPAIGN = Name(
    "mavfi_cli.campaigns.specification_file:PRESETS",
    lambda _ctx: importlib.import_module("mavfi_cli.campaigns.begin").begun(),
    files=True,
)

# Files --------------------------------------------------------------------------------------------

_MOST = 1000  # most entries of a folder that completion reads


class RunPath(click.Path):
    """The type of an argument that takes the path of a run folder, which the shell can complete."""

    def __init__(self) -> None:
        super().__init__(path_type=Path)

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        """Return the run folders whose paths complete the typed text, at most one level down.

        If there are none, complete paths as click does.
        """
        matches = [CompletionItem(str(path)) for path in sorted(_runs(incomplete))]
        return matches or super().shell_complete(ctx, param, incomplete)


def _runs(begun: str) -> Iterator[Path]:
    from mavfi_cli.mission.run_folder import RESULT

    parent, stem = Path(f"{begun}.").parent, begun.rpartition("/")[2]
    for path in _folders(parent):
        if not path.name.startswith(stem) or (path.name.startswith(".") and not stem):
            continue
        yield from (folder for folder in (path, *_folders(path)) if (folder / RESULT).is_file())


def _folders(parent: Path) -> list[Path]:
    try:
        entries = itertools.islice(parent.iterdir(), _MOST)
        return [path for path in entries if path.name.isprintable() and path.is_dir()]
    except OSError:
        return []


OUT = OutFolder()
