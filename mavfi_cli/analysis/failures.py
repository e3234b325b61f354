"""Mission failures caused by faults: per fault, per SDC of a kernel, and per flight hour.

Every injected fault counts if the golden flight of its mission succeeds, even if nothing read the
corrupted value. `mavfi kernels` counts such a flip as a benign run, so both count the same
population.

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

_STRUCK = (COUNTED | {Injected.NOT_ACTIVATED.value}) - {Injected.GOLDEN.value, Injected.NULL.value}


@dataclass(frozen=True, slots=True, kw_only=True)
class SettingFailures:
    """How often the faults of one setting of a campaign make the mission fail.

    Attributes:
        name: the labels of the setting in one phrase.
        failure: share of injected faults whose mission fails. If flights are repeatable, only
            missions whose golden flight succeeds count.
        golden: share of golden flights that fail; None if flights are repeatable, because then
            each flight is paired with its own golden flight.
        kernel: the kernel that all faults of the setting strike at instruction level; None if
            there is no such kernel, if no summary of isolated kernels was given, or if flights are
            not repeatable.
        layers: comparison with the SDCs of the isolated kernel; None if the summary has no runs of
            that kernel.
        per_hour: failures per flight hour, and the ends of the confidence interval; None unless
            requested. If flights are not repeatable, only the failures in excess of those of golden
            flights count.
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
    """Compute how often faults make missions fail, for each setting that has golden flights.

    Settings without a fault are omitted.

    Args:
        kernels: folder written by `mavfi kernels`; None leaves out `kernel` and `layers`.
        upsets_per_hour: number of bit flips per flight hour that reach the injection sites; None
            leaves out `per_hour`.

    Raises:
        RecordError: the summary in `kernels` does not exist or cannot be read.
        ConfigError: `kernels` is given, and its faults were drawn in another way than those of the
            campaign, or the sample is stratified; or `upsets_per_hour` is negative.
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
    """Yield the failures of each setting that has faults and flights that are not repeatable."""
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
    """Return the name of the only kernel that these missions attack, or None if there are several.

    The name is that in `mavfi kernels`. None is also returned if there are no missions, or if one
    of them has no instruction-level fault.
    """
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
            "its faults must be drawn by the same rules as those of the campaign, "
            f"{canonical(ours)}, but were drawn by {canonical(alone.faults)}",
            path=alone.path,
        )
