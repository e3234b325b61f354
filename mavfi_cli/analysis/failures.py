"""What faults cost beyond the golden flights, and what that means across layers and an hour.

A fault counts against a mission whose golden flight succeeds, whatever became of it once it was
injected: a flip that nothing read is one of the kernel's benign runs too. So a campaign and
`mavfi kernels` count the same population.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from mavfi_cli.analysis.groups import Group
from mavfi_cli.campaign.ledger import Ledger
from mavfi_cli.campaign.missions import canonical
from mavfi_cli.campaign.outcome import COUNTED, Injected
from mavfi_cli.core.errors import ConfigError, RecordError
from mavfi_cli.mission.config import MissionConfig
from mavfi_cli.stats.layers import cross_layer, failures_per_hour
from mavfi_cli.stats.shares import rate

KERNELS = "kernels.json"  # what `mavfi kernels --out` leaves
_STRUCK = (COUNTED | {Injected.NOT_ACTIVATED.value}) - {Injected.GOLDEN.value}
Runs = Mapping[str, tuple[int, int]]  # kernel -> silent corruptions, injected faults


def failures(
    ledger: Ledger,
    found: Sequence[Group],
    kernels: Path | None = None,
    upsets_per_hour: float | None = None,
    confidence: float = 0.95,
) -> list[dict[str, Any]]:
    """Every setting with faults that has golden flights beside it.

    Args:
        found: the settings of the ledger.
        kernels: folder of `mavfi kernels --out`.
        upsets_per_hour: bit flips that reach what is attacked in an hour of flight.

    Returns:
        Plain values. `name`: of the setting in one phrase. `failure`: injected faults that fail a
        mission, of those whose golden flight succeeds. `kernel`: that all of its faults strike at
        instruction level; None where there are several. `layers`: its own corruption beside that;
        None without runs of the kernel by itself. `per_hour`: failures a flight hour, with the
        ends of the interval; None where not asked for.

    Raises:
        RecordError: no such folder, or what is in it cannot be read.
        ConfigError: the kernels were attacked with other faults; a negative rate.
    """
    alone = None if kernels is None else _Alone(kernels)
    succeeds = [each.codes("pair")[each.counted & each.succeeded]
                for each in found if each.golden and not each.watched]  # fmt: skip
    golden = np.concatenate([np.zeros(0, dtype=np.int64), *succeeds])
    rows = []
    for group in found:
        places = group.among("injected", _STRUCK) & np.isin(group.codes("pair"), golden)
        struck = int(places.sum())
        if group.golden or not struck:
            continue
        failed = struck - int(group.succeeded[places].sum())
        failure = rate(failed, struck, confidence)
        numbers = group.codes("number")[places].tolist()
        configs = [each.mission.config for each in ledger.results(numbers)] if alone else []
        kernel, layers = _kernel(configs), None
        if alone is not None and kernel is not None and kernel in alone.runs:
            alone.require(configs[0])
            layers = cross_layer(*alone.runs[kernel], failed, struck, confidence)
        hourly = None if upsets_per_hour is None else failures_per_hour(upsets_per_hour, failure)
        rows.append(
            {
                "labels": group.labels,
                "name": group.name,
                "failure": asdict(failure),
                "kernel": kernel,
                "layers": None if layers is None else asdict(layers),
                "per_hour": hourly,
            }
        )
    return rows


def _kernel(configs: Sequence[MissionConfig]) -> str | None:
    """The one kernel that all these missions attack, as `mavfi kernels` calls it."""
    faults = [config.instruction for config in configs]
    if not faults or any(fault is None for fault in faults):
        return None
    nodes = {
        config.planner if config.instruction.node() == "planner" else config.instruction.node()
        for config in configs
        if config.instruction is not None
    }
    return nodes.pop() if len(nodes) == 1 else None


class _Alone:
    """What faults did to the kernels by themselves."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / KERNELS
        try:
            told = json.loads(self._path.read_text(encoding="utf-8"))
            plan = told["plan"]
            self._population = {name: plan[name] for name in ("rule", "compat", "model")}
            self.runs: Runs = {
                each["kernel"]: (each["outcomes"]["sdc"]["count"], each["outcomes"]["sdc"]["of"])
                for each in told["kernels"]
            }
        except OSError as error:
            raise RecordError(f"{self._path}: {error.strerror or error}") from None
        except (ValueError, KeyError, TypeError) as error:
            raise RecordError(f"{self._path}: no summary of `mavfi kernels`: {error!r}") from None

    def require(self, config: MissionConfig) -> None:
        """Have a mission's fault be drawn as those that struck the kernels."""
        fault = config.instruction
        assert fault is not None
        drawn = fault.strategy()
        ours = {"rule": drawn.rule.value, "compat": fault.compat, "model": drawn.model.to_json()}
        if ours != self._population:
            raise ConfigError(
                f"faults were drawn by {canonical(self._population)}, in the campaign by "
                f"{canonical(ours)}: not the same population",
                path=self._path,
            )
