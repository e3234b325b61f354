"""Reads campaigns, exports and summaries of isolated kernels from files and folders."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa

from mavfi_cli.analysis.flights import SETTLING, flights, provenance, read_export
from mavfi_cli.analysis.kernels import KERNELS, IsolatedKernel, KernelSummary
from mavfi_cli.analysis.pairs import Flights
from mavfi_cli.campaigns.begin import stored_spec
from mavfi_cli.campaigns.ledger import LEDGER, Ledger
from mavfi_cli.campaigns.missions import ResultState
from mavfi_cli.campaigns.specification import Spec
from mavfi_cli.campaigns.specification_file import PRESETS, load_spec
from mavfi_cli.core.errors import MavfiError, RecordError
from mavfi_cli.core.files import file_digest, reading
from mavfi_cli.core.installed import installed_versions, version_differences
from mavfi_cli.paper.beyond import Arm
from mavfi_cli.paper.items import FlightsPlan, Regime
from mavfi_cli.paper.verdicts import Settling

_EXPORT, _SPEC = ".parquet", ".toml"
_OTHERS = ("trace.parquet", "plans.parquet", "kernels.parquet")  # not exports


@dataclass(frozen=True, slots=True, kw_only=True)
class CampaignSource:
    """A campaign that was read from its folder or from an export.

    Attributes:
        path: the campaign's folder, or the exported file.
        spec: its specification; None if a program made the list of missions, or if an export has
            neither a specification next to it nor a preset of its name.
        planned: number of missions on its list; None if an export does not record it.
        flights: the flown missions.
        errors: missions that could not begin.
        versions: versions of the software that flew it; empty if an export does not record them.
        host: host of the first record; empty if an export does not record it.
        digest: SHA-256 of an exported file; empty for a folder.
        settling: the missions flown to settle claims; None if there were none.
        again: command that flies its missing missions; empty if unknown.
    """

    path: Path
    name: str
    spec: Spec | None
    flights: Flights
    planned: int | None = None
    errors: int = 0
    versions: Mapping[str, str] = field(default_factory=dict)
    host: Mapping[str, Any] = field(default_factory=dict)
    digest: str = ""
    settling: Settling | None = None
    again: str = ""

    @property
    def may_have_runs(self) -> bool:
        """Whether run folders may be read. Paths in an export are not trusted."""
        return self.path.is_dir()

    @property
    def stacks(self) -> list[str]:
        """The stacks on which missions were flown, sorted by name."""
        return sorted(set(self.flights["stack"]))

    @property
    def seeds(self) -> tuple[int, int] | None:
        """The smallest and the largest seed of its flights, or None if it has no flights."""
        seeds = [seed for seed in self.flights["seed"] if seed is not None]
        return (min(seeds), max(seeds)) if seeds else None


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """The campaigns and kernel summaries that were read, with the problems found in them.

    Attributes:
        problems: one sentence for each source that could not be read, is incomplete, or does not
            match the paper or the other sources.
    """

    campaigns: Sequence[CampaignSource]
    kernels: Sequence[KernelSummary]
    problems: Sequence[str]

    @classmethod
    def gather(cls, places: Sequence[Path]) -> Evidence:
        """Read all campaigns and kernel summaries at the given paths.

        Args:
            places: exports, and folders with campaigns or results of `mavfi kernels` at any depth.

        Raises:
            RecordError: a path does not exist, or no path has a flown mission or a kernel summary.
        """
        campaigns: list[CampaignSource] = []
        kernels: list[KernelSummary] = []
        problems: list[str] = []
        for place in places:
            before = len(campaigns) + len(kernels) + len(problems)
            for path in _paths_in(place):
                try:
                    with reading(path):
                        source = _read(path)
                except (MavfiError, OSError) as error:
                    problems.append(f"Not read: {error}.")
                    continue
                if isinstance(source, CampaignSource):
                    campaigns.append(source)
                else:
                    kernels.append(source)
            if len(campaigns) + len(kernels) + len(problems) == before:
                problems.append(f"{place}: holds no campaign, no export and no {KERNELS}.")
        if not any(len(source.flights) for source in campaigns) and not kernels:
            none = (f"{source.path}: no mission has flown yet" for source in campaigns)
            raise RecordError("; ".join(problem.rstrip(".") for problem in problems or none))
        problems += [
            *_incomplete(campaigns), *_unpaired(campaigns), *_mixed(campaigns),
            *_repeated(kernels),
        ]  # fmt: skip
        return cls(campaigns=campaigns, kernels=kernels, problems=problems)

    @property
    def isolated(self) -> Mapping[str, IsolatedKernel]:
        """The summary of each isolated kernel, by name, from the last source that has it."""
        return {kernel.name: kernel for source in self.kernels for kernel in source.kernels}

    @property
    def settled(self) -> Mapping[str, Settling]:
        """The missions flown to settle claims, by place, from the last campaign that has any.

        A place has the names that `by_place` gives it, and those without the kind of worlds.
        """
        return {
            Regime(stack, kind, rule).name: source.settling
            for source in self.campaigns
            if source.settling is not None
            for rule, mine in source.flights.by_rules.items()
            if any(mine["level"])
            for stack in source.stacks
            for kind in ("", *source.flights.by_worlds)
        }

    def by_place(self, stacks: Sequence[str]) -> dict[str, Flights]:
        """Return the flights of each stack, split by `Regime.split`."""
        places = dict[str, Flights]()
        for stack in stacks:
            places |= Regime.split(stack, self.flights(stack))
        return places

    def flights(self, stack: str | None = None) -> Flights:
        """Return the flights of a stack, or of all stacks if None, without duplicate missions."""
        return Flights.pooled([campaign.flights for campaign in self.campaigns], stack)


def _paths_in(place: Path) -> Iterator[Path]:
    """Yield the ledgers, kernel summaries and exports at any depth of a folder, sorted.

    A file yields only itself.
    """
    if not place.exists():
        raise RecordError(f"{place}: does not exist")
    if place.is_file():
        yield place
        return
    yield from sorted(
        path
        for path in place.rglob("*")
        if (path.name in (KERNELS, LEDGER) or path.suffix == _EXPORT)
        and path.name not in _OTHERS
        and not _inside_campaign(path, place)
    )


def _inside_campaign(path: Path, place: Path) -> bool:
    """Return True if a path lies in a subfolder of a campaign, such as that of a kept run."""
    above = [folder for folder in path.parent.parents if folder.is_relative_to(place)]
    return any((folder / LEDGER).is_file() for folder in above)


def _read(path: Path) -> CampaignSource | KernelSummary:
    if path.name == LEDGER:
        return _from_ledger(path.parent)
    if path.suffix == _EXPORT:
        return _from_export(path)
    return KernelSummary.read(path)


def _from_ledger(folder: Path) -> CampaignSource:
    with Ledger(folder) as ledger:
        table, origin, spec = flights(ledger), provenance(ledger), stored_spec(ledger)
        plan = FlightsPlan.stored(ledger)
    again = "" if spec is None else shlex.join(["mavfi", "campaign", "run", str(folder)])
    again = again if plan is None else plan.command
    return _campaign(folder, spec, table, origin, name=origin["name"] or folder.name, again=again)


def _from_export(path: Path) -> CampaignSource:
    table = read_export(path)
    spec = _spec_beside(path)
    origin, digest = provenance(table), file_digest(path)
    return _campaign(path, spec, table, origin, name=path.stem, digest=digest)


_ORIGIN = {"planned": int | None, "versions": Mapping, "host": Mapping}


def _campaign(
    path: Path, spec: Spec | None, table: pa.Table, origin: Mapping[str, Any], **more: Any
) -> CampaignSource:
    errors = table["state"].to_pylist().count(ResultState.ERROR.value)
    known = {name: origin[name] for name in _ORIGIN if name in origin}
    for name, value in known.items():
        parts = value.values() if isinstance(value, Mapping) else ()
        nested = any(isinstance(part, (Mapping, list)) for part in parts)
        if nested or not isinstance(value, _ORIGIN[name]):
            raise RecordError(f"{path}: the provenance field {name!r} is damaged")
    more["settling"] = Settling.of(origin.get(SETTLING))
    more |= {"flights": Flights.of(table), "errors": errors}
    return CampaignSource(path=path, spec=spec, **known, **more)


def _spec_beside(path: Path) -> Spec | None:
    """Load an export's specification: NAME.toml next to it, or else the preset NAME.

    NAME is the export's file name without its suffix, or also without `-part` and what follows.
    Return None if there is neither.
    """
    for stem in (path.stem, path.stem.rpartition("-part")[0]):
        if stem and (beside := path.with_name(stem + _SPEC)).is_file():
            return load_spec(str(beside))
        if stem in PRESETS.names:
            return load_spec(stem)
    return None


# What is missing ----------------------------------------------------------------------------------


def _incomplete(campaigns: Sequence[CampaignSource]) -> Iterator[str]:
    for source in campaigns:
        over = len(source.flights) + source.errors
        if source.planned is not None and over < source.planned:
            rest = f"{source.again or 'The command that began it'} flies the rest."
            rest = "An export cannot fly the rest." if source.digest else rest
            yield f"{source.path.name}: {over:,} of {source.planned:,} missions have flown. {rest}"
        if source.errors:
            errors = f"{source.errors:,} missions could not begin"
            yield f"{source.path.name}: {errors}; they are not counted."


def _unpaired(campaigns: Sequence[CampaignSource]) -> Iterator[str]:
    """Yield a sentence for each campaign with faulty flights that lack a golden flight.

    Yield another one for each campaign in which no flight is like the paper's. Flights of users'
    companions are neither paired nor compared with the paper.
    """
    pooled = Flights.pooled([source.flights for source in campaigns])
    paired = _with_golden(pooled)
    of_base = set[str]().union(*map(_with_golden, Arm.by_base(pooled).values())) - paired
    for source in campaigns:
        repeated = source.flights.chosen(companion=None)
        faulty = repeated.chosen(level=("source", "instruction"))
        of_others = sum(changes in of_base for changes in faulty["changes"])
        alone = sum(changes not in paired for changes in faulty["changes"]) - of_others
        if alone:
            yield (
                f"{source.path.name}: {alone:,} of {len(faulty):,} flights with a fault have no "
                "golden flight of the same mission here, so they show no effect of the fault."
            )
        if of_others:
            yield (
                f"{source.path.name}: {of_others:,} of {len(faulty):,} flights with a fault have "
                "no golden flight with all their protections; one with fewer or none stands in."
            )
        if len(repeated) and not any(repeated["as_paper"]):
            yield (
                f"{source.path.name}: no flight is like the paper's (its vehicle, speed and "
                "sensors, and one flip of drawn bits), so none judges a claim."
            )


def _with_golden(flights: Flights) -> set[str]:
    """Return the configurations of the flights that have a golden flight, as text."""
    both = zip(flights["changes"], flights["own_lost"], strict=True)
    return {changes for changes, own in both if own is not None}


def _repeated(kernels: Sequence[KernelSummary]) -> Iterator[str]:
    first: dict[str, str] = {}
    for source in kernels:
        place = str(Path(*source.path.parts[-2:]))
        for name in (kernel.name for kernel in source.kernels):
            if name in first:
                yield f"{first[name]} and {place} both have {name}; the latter counts."
            first[name] = place


def _mixed(campaigns: Sequence[CampaignSource]) -> Iterator[str]:
    versioned = [source for source in campaigns if source.versions]
    for source in versioned[1:]:
        if differences := version_differences(versioned[0].versions, source.versions):
            builds = f"{source.path.name} and {versioned[0].path.name} were flown by other builds"
            yield f"{builds}: {', '.join(differences)}."
    unnamed = [
        source.path.name for source in campaigns if not source.versions and len(source.flights)
    ]
    if unnamed:
        yield (
            f"{', '.join(unnamed)}: the export does not name the builds that flew it, so nothing "
            "shows whether it mixes several."
        )
    here = installed_versions()
    if versioned and (differences := version_differences(versioned[0].versions, here)):
        yield (
            f"{versioned[0].path.name} was flown by another build than this one, so its missions "
            f"may not repeat here: {', '.join(differences)}."
        )
