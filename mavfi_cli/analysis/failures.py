"""Mission failures caused by faults: per fault, per SDC of a kernel, and per flight hour.

Every injected fault counts if the golden flight of its mission succeeds, even if nothing read the
struck value. `mavfi kernels` counts such a flip as a benign run, so both count the same population.

The flights of a user's companion are not repeatable. For these, every injected fault counts, and
the failures of all golden flights are given for comparison.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mavfi_cli.analysis.kernels import KERNELS, KernelSummary
from mavfi_cli.analysis.summary import Group
from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.campaigns.missions import COUNTED, Injected, Labels, canonical
from mavfi_cli.core.errors import ConfigError
from mavfi_cli.spec.mission import MissionConfig
from mavfi_cli.stats.shares import CrossLayer, Share, cross_layer

_STRUCK = (COUNTED | {Injected.NOT_ACTIVATED.value}) - {Injected.GOLDEN.value}


@dataclass(frozen=True, slots=True, kw_only=True)
class SettingFailures:
    """Missions of a setting that fail because of its faults.

    Attributes:
        name: phrase for the setting.
        failure: share of injected faults whose mission fails; only missions whose golden flight
            succeeds count, unless flights are not repeatable.
        golden: share of golden flights that fail, if flights are not repeatable; None for pairs.
        kernel: the kernel that all its faults strike at instruction level; None if there is no
            such kernel, or without a summary of isolated kernels.
        layers: comparison with the SDCs of the isolated kernel; None without runs of that kernel.
        per_hour: failures per flight hour with the ends of the interval; None unless requested.
            If flights are not repeatable, only failures in excess of those of golden flights.
    """

    labels: Labels
    name: str
    failure: Share
    golden: Share | None
    kernel: str | None
    layers: CrossLayer | None
    per_hour: tuple[float, float, float] | None


def setting_failures(
    ledger: Ledger,
    groups: Sequence[Group],
    kernels: Path | None = None,
    upsets_per_hour: float | None = None,
    confidence: float = 0.95,
) -> list[SettingFailures]:
    """Compute the failures of every setting with faults that has golden flights.

    Args:
        kernels: folder with a summary of isolated kernels; None leaves out `layers`.
        upsets_per_hour: bit flips that reach the injection sites per flight hour.

    Raises:
        RecordError: the folder does not exist or cannot be read.
        ConfigError: `kernels` is given, and its faults differ from the campaign's or the sample is
            stratified; or the rate is negative.
    """
    alone = None if kernels is None else KernelSummary.read(kernels / KERNELS)
    silent = {own.name: own.outcomes["sdc"] for own in alone.kernels} if alone else {}
    pairs = Group.parts(groups, repeats=True)
    succeeds = [group.codes("pair")[group.counted & group.succeeded]
                for group in pairs if group.golden and not group.watched]  # fmt: skip
    golden = np.concatenate([np.zeros(0, dtype=np.int64), *succeeds])
    rows = []
    for group in pairs:
        places = group.among("injected", _STRUCK) & np.isin(group.codes("pair"), golden)
        struck = int(places.sum())
        if group.golden or not struck:
            continue
        failed = struck - int(group.succeeded[places].sum())
        failure = group.share(~group.succeeded, places, confidence)
        numbers = group.codes("number")[places].tolist()
        configs = list(ledger.configs(numbers)) if alone else []
        kernel, layers = _kernel(configs), None
        if alone is not None and kernel in silent:
            _require_same_faults(configs[0], alone)
            sdc = silent[kernel]
            if group.stratified:
                problem = "cannot be combined with a stratified sample, whose missions have weights"
                raise ConfigError(problem, key="kernels")
            layers = cross_layer(sdc.count, sdc.total, failed, struck, confidence)
        rows.append(
            SettingFailures(
                labels=group.labels,
                name=group.name,
                failure=failure,
                golden=None,
                kernel=kernel,
                layers=layers,
                per_hour=None if upsets_per_hour is None else failure.per_hour(upsets_per_hour),
            )
        )
    return [*rows, *_unpaired(Group.parts(groups, repeats=False), upsets_per_hour, confidence)]


def _unpaired(
    groups: Sequence[Group], upsets_per_hour: float | None, confidence: float
) -> Iterator[SettingFailures]:
    """Yield the failures of the settings with faults whose flights are not repeatable."""
    for group in groups:
        golden, places = group.golden_among(groups), group.among("injected", _STRUCK)
        if golden is None or not places.any():
            continue
        failure = group.share(~group.succeeded, places, confidence)
        without = golden.share(~golden.succeeded, golden.counted, confidence)
        more = failure.minus(without)
        share, low, high = (max(0.0, end) for end in (more.value, more.low, more.high))
        added = replace(failure, share=share, low=low, high=high)
        yield SettingFailures(
            labels=group.labels,
            name=group.name,
            failure=failure,
            golden=without,
            kernel=None,
            layers=None,
            per_hour=None if upsets_per_hour is None else added.per_hour(upsets_per_hour),
        )


def _kernel(configs: Sequence[MissionConfig]) -> str | None:
    """Return the name in `mavfi kernels` of the only kernel that these missions attack, or None."""
    faults = [config.instruction for config in configs]
    if not faults or any(fault is None for fault in faults):
        return None
    nodes = {
        config.planner if config.instruction.node() == "planner" else config.instruction.node()
        for config in configs
        if config.instruction is not None
    }
    return nodes.pop() if len(nodes) == 1 else None


def _require_same_faults(config: MissionConfig, alone: KernelSummary) -> None:
    from mavfi_cli.attack.live import mission_strategy  # loads the tracer

    fault = config.instruction
    assert fault is not None
    drawn = mission_strategy(fault)
    ours = {"rule": drawn.rule.value, "compat": fault.compat, "model": drawn.model.to_json()}
    if ours != alone.faults:
        raise ConfigError(
            f"its faults must be drawn as in the campaign, by {canonical(ours)}, "
            f"but were drawn by {canonical(alone.faults)}",
            path=alone.path,
        )
