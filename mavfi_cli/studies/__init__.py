"""Studies: each flies the missions that answer one question, and analyses them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pyarrow as pa

from mavfi_cli.analysis.flights import flights
from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.campaigns.missions import PlannedMission
from mavfi_cli.campaigns.progress import Spectator
from mavfi_cli.campaigns.run import Options, fly_missing, store_plan
from mavfi_cli.campaigns.specification import Keep


def fly(
    missions: Sequence[PlannedMission],
    folder: Path,
    keep: Keep,
    options: Options,
    spectator: Spectator,
) -> pa.Table:
    """Fly those `missions` that have no result in `folder` yet, and return a table of all of them.

    The folder's list may contain other missions, left by a larger plan that was interrupted. These
    are not flown.

    Raises:
        CampaignStopped, RecordError, Interrupted: as `run_campaign`.
    """
    wanted = {mission.stored for mission in missions}
    with Ledger(folder, writing=True) as ledger:
        ledger.set_meta({"name": folder.name, "keep": keep.value})  # `campaign run` needs them
        store_plan(ledger, missions, append=True)
        mine = [number for number, *stored in ledger.rows() if tuple(stored) in wanted]
        fly_missing(ledger, replace(options, keep=keep, only=frozenset(mine)), spectator)
        return flights(ledger, mine)
