"""What all studies do: check what is named, fly a list into a folder, and read its table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pyarrow as pa

from mavfi_cli.analysis.flights import flights
from mavfi_cli.campaigns.missions import PlannedMission
from mavfi_cli.campaigns.progress import Spectator
from mavfi_cli.campaigns.run import Options, run_campaign
from mavfi_cli.campaigns.specification import Keep
from mavfi_cli.core.config import require_distinct
from mavfi_cli.core.errors import ConfigError, UnknownName


def fly(
    missions: Sequence[PlannedMission],
    folder: Path,
    keep: Keep,
    options: Options,
    spectator: Spectator,
) -> pa.Table:
    """Fly the missions that the folder lacks; return all of them, as `analysis.flights`.

    Raises:
        CampaignStopped, RecordError, Interrupted: as `run_campaign`.
    """
    with run_campaign(
        missions, folder, replace(options, keep=keep), spectator, append=True
    ) as ledger:
        return flights(ledger, missions)


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
    for name in names:
        if known is not None and name not in known:
            raise UnknownName(key, name, known)
    require_distinct(names, key)
