"""Prepares a campaign's folder and missions from a preset, a TOML file or a folder."""

from __future__ import annotations

import contextlib
import itertools
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

from mavfi_cli.campaigns.ledger import LEDGER, ExportedLedger, Ledger, is_export
from mavfi_cli.campaigns.missions import (
    PlannedMission,
    Sampling,
    canonical,
    changes_of,
    kind_of,
    label_text,
    naming,
)
from mavfi_cli.campaigns.progress import Spectator
from mavfi_cli.campaigns.run import (
    MissionQueue,
    Options,
    require_unchanged,
    run_campaign,
    store_plan,
)
from mavfi_cli.campaigns.specification import FixedWorld, Flown, Keep, Spec
from mavfi_cli.campaigns.specification_file import PRESETS, load_spec, parse_spec, replaced
from mavfi_cli.campaigns.strata import ROUND, Rounds
from mavfi_cli.companion.pipeline import CompanionParts
from mavfi_cli.core.errors import (
    ConfigError,
    FaultSpecError,
    MavfiError,
    UnknownName,
    VehicleProcessError,
)
from mavfi_cli.core.files import reading, write_text
from mavfi_cli.core.types import Outcome
from mavfi_cli.mission.companion_faults import check_companion_fault
from mavfi_cli.mission.vehicle import VehicleInProcess
from mavfi_cli.spec.companion import CompanionConfig
from mavfi_cli.spec.mission import MissionConfig

DEFAULT, SPEC = Path("campaigns"), "campaign.toml"
SEARCH = "world-search"  # folder of the campaign that finds fixed worlds
_AT_ONCE = 4  # candidate seeds of a world that are flown at the same time
_APPEND = "--append adds what is new"
# Missions that differ only in these fields are checked once. Every world is still checked with its
# vehicle process.
_ALIKE = ("seed", "time_limit_s", "isolate", "world")


def chosen(
    what: str,
    out: Path | None,
    scale: float | None,
    changes: Sequence[str] = (),
    programs: Sequence[str | None] = (),
    sampling: Sampling | None = None,
    *,
    worlds: str | None = None,
) -> tuple[Spec, Path]:
    """Return the specification and the folder of the campaign that `what` names.

    Args:
        what: a preset, a TOML file, or the folder of an existing campaign.
        out: the campaign's folder; None means campaigns/NAME, or the folder that `what` names.
        scale: fraction of the repetitions; None for an existing folder, which stores its own.
        changes: factors to replace, as in `replaced`; they become part of the default folder's
            name.
        programs: programs that the missions in an existing folder are allowed to execute; see
            `MissionConfig.require_programs`.
        sampling: how faults are drawn; None means as specified. A change becomes part of the name
            too.
        worlds: `fixed` or `many`, as in `Spec.in_worlds`; None means as specified.

    Raises:
        ConfigError: the specification or the scale is invalid, or `out` is None and the name is
            that of both a preset and a campaign's folder in the working directory.
        UnknownName: no preset, file or folder has this name.
    """
    spec = chosen_spec(what, scale, changes, out, programs, sampling, worlds=worlds)
    if (folder := _folder(what)) is not None:
        return spec, folder
    if out is None:
        _require_one_meaning(what)
    return spec, out or DEFAULT / spec.name


def chosen_spec(
    what: str,
    scale: float | None,
    changes: Sequence[str] = (),
    out: Path | None = None,
    programs: Sequence[str | None] = (),
    sampling: Sampling | None = None,
    *,
    worlds: str | None = None,
) -> Spec:
    """Return the specification of the campaign that `what` names, but not its folder.

    See `chosen` for the arguments and errors.
    """
    folder = _folder(what)
    if folder is None:
        spec = load_spec(what)
        spec = replaced(spec if worlds is None else spec.in_worlds(worlds), changes)
        spec = spec if scale is None else spec.scaled(scale)
        return spec if sampling is None else spec.sampled(sampling)
    with Ledger(folder) as ledger:
        if changes or (scale, out, sampling, worlds) != (None,) * 4:
            raise ConfigError(
                "cannot be combined with --scale, --set, --sampling, --worlds or --out, because "
                "the folder stores them",
                path=folder,
            )
        stored = stored_spec(ledger) or _Unflown.of(ledger)
    for kind in stored.kinds():
        kind.config.require_programs(*programs)
    return stored


@dataclass(frozen=True, slots=True, kw_only=True)
class _Unflown(Spec):
    """A specification that lists the unfinished missions of a ledger that stores no factors."""

    left: list[PlannedMission]

    @classmethod
    def of(cls, ledger: Ledger) -> Self:
        """Read the missions that have no result, and those that could not begin, from a ledger.

        Raises:
            ConfigError: the ledger does not store which run folders to keep.
        """
        keep = ledger.meta("keep")
        if keep is None:
            problem = (
                "has no specification, so this command cannot continue it; use the command that "
                "created it"
            )
            raise ConfigError(problem, path=ledger.folder)
        cells, pairs = ledger.cells(), {row[0]: row[2] for row in ledger.rows()}
        left = [
            PlannedMission(config=config, labels=cells[cell], pair=pairs[number])
            for number, cell, config in ledger.missing(errors=True)
        ]
        return cls(name=ledger.folder.name, keep=Keep(keep), left=left)

    def missions(self) -> list[PlannedMission]:
        """Return the unfinished missions instead of a combination of factors."""
        return self.left

    kinds = missions


def _folder_of(what: str) -> Path:
    """Return the folder that `what` names, or the default folder of the campaign that it names.

    Args:
        what: a preset, a TOML file, or the folder of a campaign. A preset's name means the preset,
            and ./NAME means the folder. If ./NAME holds a campaign, the name alone is an error.

    Raises:
        ConfigError: a file is not a valid specification, or a name has two meanings.
        UnknownName: a single word is neither a preset nor a folder.
    """
    if (folder := _folder(what)) is not None:
        return folder
    _require_one_meaning(what)
    return DEFAULT / load_spec(what).name


@contextlib.contextmanager
def opened(what: str | Path) -> Iterator[Ledger]:
    """Open the ledger of a campaign for reading, and close it at the end of the block.

    Args:
        what: a preset, a TOML file, the folder of a campaign, or an exported .parquet file.

    Raises:
        MavfiError: as `_folder_of`, `Ledger` and `ExportedLedger`.
        RecordError: an error in the block reveals damaged data.
    """
    path = Path(what)
    ledger = ExportedLedger(path) if is_export(path) else Ledger(_folder_of(str(what)))
    with ledger, reading(ledger.folder):
        yield ledger


def _folder(what: str) -> Path | None:
    """Return the folder of a campaign if `what` names one, or None for a preset or a TOML file.

    Raises:
        ConfigError: `what` names an export.
        UnknownName: no preset, file or folder has this name.
    """
    folder = Path(what)
    if what in PRESETS.names:
        return None
    if is_export(folder):
        raise ConfigError(
            "cannot fly missions from an export, because it contains no mission list", path=folder
        )
    if folder.is_dir() or (os.sep in what and folder.suffix != ".toml"):
        return folder
    if folder.suffix == ".toml":
        return None
    meant = [other for other in begun() if Path(other).name == what]
    raise UnknownName("campaign", what, meant or [*PRESETS.names, *begun()])


def begun() -> list[str]:
    """Return the paths of all campaign folders in `campaigns`, the default location, sorted."""
    return sorted(str(path.parent) for path in DEFAULT.glob(f"*/{LEDGER}"))


def _require_one_meaning(what: str) -> None:
    """Raise ConfigError if `what` names both a preset and a folder that holds a campaign."""
    if what in PRESETS.names and (Path(what) / LEDGER).is_file():
        own = DEFAULT / what
        raise ConfigError(
            f"{what} is a preset, and .{os.sep}{what} holds a campaign: use .{os.sep}{what} for "
            f"that campaign, or {own} for the preset's, which --out {own} creates"
        )


def resumed(spec: Spec, folder: Path, what: str, *, repetitions: str) -> tuple[Spec, bool]:
    """Match a study's specification with the study that a folder may already hold.

    A study with more repetitions continues one with fewer, because lists grow by repetition.

    Args:
        what, repetitions: words for the study and its repetitions in error messages.

    Returns:
        The specification with the stored name, description and policy for run folders, if any, and
        whether missions must be appended to the stored list.

    Raises:
        ConfigError: the folder holds another campaign.
    """
    if not (folder / LEDGER).is_file():
        return spec, False
    with Ledger(folder) as ledger:
        stored = stored_spec(ledger)
    if stored is None:  # killed too early, or another study: `store_plan` compares the lists
        return spec, False
    ours = replace(spec, name=stored.name, about=stored.about, keep=stored.keep)
    grows = spec.repetitions > stored.repetitions
    alike = replace(ours, repetitions=stored.repetitions) if grows else ours
    if differences := stored.differences(alike, repetitions):
        raise ConfigError(
            f"holds another {what}: {'; '.join(differences)}; choose another --out", path=folder
        )
    return ours, grows


def stored_spec(ledger: Ledger) -> Spec | None:
    """Return the specification stored in a ledger, or None if its list was made without one."""
    text = ledger.meta("spec")
    return None if text is None else parse_spec(text, ledger.folder / SPEC)


def stopped(ledger: Ledger) -> list[str]:
    """Return the labels, as a phrase, of each setting that the stopping rule has ended early."""
    spec = stored_spec(ledger)
    if spec is None or spec.stop is None:
        return []
    cells = ledger.cells()
    queue = MissionQueue(
        iter(()), spec.stop, ledger.mission_cells(), ledger.fates(), drawn=ledger.draws()
    )
    return [label_text(cells[cell]) for cell in sorted(queue.stopped)]


def rounds_of(spec: Spec, ledger: Ledger) -> Rounds | None:
    """Return the rounds in which a stratified campaign draws faults, or None for a uniform one.

    Args:
        ledger: the campaign's ledger, open for writing, with a stored list of missions.
    """
    if spec.sampling is Sampling.UNIFORM:
        return None
    return Rounds(ledger, spec.seed, spec.stop.batch if spec.stop else ROUND)


def begin(
    spec: Spec,
    folder: Path,
    *,
    append: bool = False,
    missing_only: bool = False,
    options: Options | None = None,
    spectator: Spectator | None = None,
) -> Ledger:
    """Open the ledger of a campaign for writing, and store the campaign's list of missions.

    Args:
        append: add missions that an already stored list lacks.
        missing_only: accept only a folder that already holds a campaign.
        options, spectator: used by the flights that search for fixed worlds, if there are any.

    Raises:
        ConfigError: the folder holds another campaign, `missing_only` is set and it holds none, or
            missions are appended to a stratified campaign.
        MavfiError: the missions cannot be flown with the chosen world, vehicle, planner or other
            setting, or no world seed satisfies the rule in [fixed_world].
    """
    begun = (folder / LEDGER).is_file()
    if append and spec.sampling is Sampling.STRATIFIED:
        raise ConfigError("must not be used with a stratified campaign", key="append")
    if missing_only and not begun:
        raise ConfigError("holds no campaign to resume", path=folder)
    if begun:
        spec = _with_stored_worlds(spec, folder, append=append)
    missions = None if begun else flyable(spec)  # checked before a folder exists
    if spec.fixed_world is not None and (append or not begun):
        spec = _with_worlds(
            spec, missions or flyable(spec), folder, options or Options(), spectator or Spectator()
        )
        missions = flyable(spec)
    text = spec.to_toml()
    with contextlib.ExitStack() as undo:
        ledger = undo.enter_context(Ledger(folder, writing=True))
        if begun and (
            isinstance(spec, _Unflown) or ledger.meta("spec") == text
        ):  # the stored list is what it expands to
            require_unchanged(ledger)
        else:
            stored = stored_spec(ledger)
            store_plan(
                ledger,
                missions or flyable(spec),
                append=append,
                differing=[] if stored is None else stored.differences(spec),
                can_append=_APPEND,
            )
            ledger.set_meta({"spec": text, "name": spec.name})
            write_text(ledger.folder / SPEC, text)
        undo.pop_all()
    return ledger


def _with_stored_worlds(spec: Spec, folder: Path, *, append: bool) -> Spec:
    """Return the specification with the seeds of fixed worlds that its folder already stores.

    If the stored rule for fixed worlds differs, return the specification unchanged.

    Raises:
        ConfigError: missions are to be appended, but the rule for fixed worlds has changed.
    """
    with Ledger(folder) as ledger:
        stored = stored_spec(ledger)
    here, there = spec.fixed_world, stored.fixed_world if stored else None
    if append and stored and (here and here.rule()) != (there and there.rule()):
        raise ConfigError(
            "holds a campaign with another [fixed_world] rule; choose another folder", path=folder
        )
    if here is None or there is None or here.rule() != there.rule():
        return spec
    known = replace(
        here,
        world_seed={**there.world_seed, **here.world_seed},
        flown={**there.flown, **here.flown},
    )
    return replace(spec, fixed_world=known)


def flyable(spec: Spec) -> list[PlannedMission]:
    """Return the missions of a campaign, after checking that every kind of mission can be flown.

    Raises:
        MavfiError: as `Spec.missions` and `check_kinds`.
    """
    check_kinds(spec.kinds())
    return spec.missions()


def check_kinds(missions: Iterable[PlannedMission]) -> None:
    """Check that every kind of mission can be flown, and every kind of vehicle process starts.

    Raises:
        MavfiError: as `check_names`, with the labels of the setting added.
    """
    seen: set[str] = set()
    for mission in missions:
        config = mission.config
        key = kind_of(changes_of(config), _ALIKE)
        simple = changes_of(replace(config.golden, seed=0))
        vehicle = canonical({**simple, "planner": None, "platform": None, "stack": None})
        if key in seen and vehicle in seen:
            continue
        with naming(mission.labels):
            check_names(config, start=vehicle not in seen)
        seen |= {key, vehicle}


def check_names(config: MissionConfig, *, start: bool = True) -> None:
    """Check that a mission with this configuration can be flown, without flying it.

    Args:
        start: also start the simulated vehicle, and stop it immediately.

    Raises:
        VehicleProcessError: the simulation rejects the world, the vehicle, the start or the goal.
        MavfiError: a world, vehicle, planner, platform, stack or target does not exist; a model
            belongs to another stack; a fault is invalid; or the start is blocked.
    """
    CompanionParts.of(config)
    users = None if config.companion is None else CompanionConfig.load(config.companion)
    fault = config.fault or config.instruction
    if fault is not None and users is not None:
        check_companion_fault(fault, users)
    elif config.fault is not None:
        config.fault.check()
    if config.instruction is not None:
        from mavfi_cli.attack.live import mission_strategy  # loads the tracer

        mission_strategy(config.instruction)
        if users is None:
            config.instruction.node()
    if config.detector is not None and users is not None:
        config.detector.build_for_companion(users.mark)
    elif config.detector is not None:
        config.detector.build(config.stack)
    elif config.fault is not None and config.fault.attacks_detector:
        raise FaultSpecError("a fault in the detector requires a detector")
    if start:
        try:
            VehicleInProcess(config).end()
        except MavfiError as error:
            raise VehicleProcessError(str(error), error.exit_code) from None


# Fixed worlds: golden runs are flown in candidate worlds until one satisfies the rule. These runs
# form a campaign of their own in a subfolder, so an interrupted search continues where it stopped.


def _with_worlds(
    spec: Spec,
    missions: Sequence[PlannedMission],
    folder: Path,
    options: Options,
    spectator: Spectator,
) -> Spec:
    """Return the specification with a seed for every world that its rule for fixed worlds covers.

    A candidate seed is judged by golden flights of the first mission in that world. This mission
    has the first value of every other factor, so all stacks and platforms share the chosen seed.

    Args:
        missions: the specification's missions.
        folder: folder of the campaign.

    Raises:
        ConfigError: no candidate seed satisfies the rule.
        MavfiError: as `run_campaign`.
    """
    rule = spec.fixed_world
    assert rule is not None
    judged: dict[str, MissionConfig] = {}
    for mission in missions:
        config = mission.config
        if config.world_seed is None and rule.rules(config.world):
            judged.setdefault(config.world, config.golden)
    quiet = Spectator()  # notes only: the progress of a search is not the campaign's
    quiet.on_note = spectator.on_note  # type: ignore[method-assign]
    for world, config in judged.items():
        golden = replace(config, seed=spec.first_seed)
        flown = _search(rule, golden, folder / SEARCH, replace(options, keep=Keep.NONE), quiet)
        seeds = {**rule.world_seed, world: len(flown)}
        rule = replace(rule, world_seed=seeds, flown={**rule.flown, world: flown})
        spectator.on_note(f"fixed world {world}: seed {len(flown)}")
    return replace(spec, fixed_world=rule)


def _search(
    rule: FixedWorld, config: MissionConfig, folder: Path, options: Options, spectator: Spectator
) -> Flown:
    flown: Flown = ()
    for first in range(1, rule.candidates + 1, _AT_ONCE):
        seeds = range(first, min(first + _AT_ONCE, rule.candidates + 1))
        spectator.on_note(f"fixed world {config.world}: seeds {first} to {seeds[-1]} are flown")
        planned = [
            PlannedMission(
                config=replace(config, world_seed=seed, seed=config.seed + flight),
                labels={"world": config.world, "world_seed": seed},
            )
            for seed in seeds
            for flight in range(rule.flights)
        ]
        with run_campaign(planned, folder, options, spectator, append=True) as ledger:
            pilots = {
                result.mission.config: result.flight.pilot
                for result in ledger.results()
                if result.outcome == Outcome.SUCCESS.value
            }
        for seed in seeds:
            configs = (mission.config for mission in planned)
            own = (pilots.get(config) for config in configs if config.world_seed == seed)
            flown = (*flown, tuple(pilot.replans for pilot in own if pilot is not None))
            if rule.fits(flown[-1]):
                return flown[:seed]
    often = sorted(itertools.chain.from_iterable(flown))
    seen = f"; the flights replanned {often[0]} to {often[-1]} times" if often else ""
    if lost := sum(not rule.succeeds(replans) for replans in flown):
        seen += f"; in {lost} of these worlds at least half of the golden flights failed"
    assert rule.replans is not None
    least, most = rule.replans
    raise ConfigError(
        f"no world seed of {config.world} from 1 to {rule.candidates} gives a median of {least} to "
        f"{most} replans over {rule.flights} golden flights{seen}; leave the world out of "
        "`worlds`, or set its seed in [fixed_world.world_seed]",
        key="fixed_world",
    )
