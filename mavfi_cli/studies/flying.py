"""What all studies do: check what is named, fly a list into a folder, and read its table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pyarrow as pa

from mavfi_cli.analysis.flights import flights
from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.campaigns.missions import PlannedMission, canonical, changes_of
from mavfi_cli.campaigns.progress import Spectator
from mavfi_cli.campaigns.run import Options, fly_missing, store_plan
from mavfi_cli.campaigns.specification import Keep
from mavfi_cli.core.errors import ConfigError, UnknownName


def fly(
    missions: Sequence[PlannedMission],
    folder: Path,
    keep: Keep,
    options: Options,
    spectator: Spectator,
) -> pa.Table:
    """Fly the missions that the folder lacks; return all of them, as `analysis.flights`.

    Others that an interrupted larger plan has left in the folder's list are not flown.

    Raises:
        CampaignStopped, RecordError, Interrupted: as `run_campaign`.
    """
    wanted = {
        (canonical(dict(each.labels)), canonical(changes_of(each.config))) for each in missions
    }
    with Ledger(folder, writing=True) as ledger:
        store_plan(ledger, missions, append=True)
        mine = [number for number, labels, _, changes in ledger.rows()
                if (labels, changes) in wanted]  # fmt: skip
        fly_missing(ledger, replace(options, keep=keep, only=frozenset(mine)), spectator)
        return flights(ledger, mine)


def require_named(
    key: str, names: Sequence[str], known: Sequence[str] | None = None, least: int = 1
) -> None:
    """Require some names, each once and each known.

    Raises:
        ConfigError: too few, or one twice.
        UnknownName: a name is not among the known ones, if they are given.
    """
    if len(names) < least:
        raise ConfigError("name at least one", key=key)
    for place, name in enumerate(names):
        if known is not None and name not in known:
            raise UnknownName(key, name, known)
        if name in names[:place]:
            raise ConfigError(f"{name} is named twice", key=key)
