"""Flies one mission of a campaign again, from its ledger or from an export of it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow.compute as pc

from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.core.config import structure
from mavfi_cli.core.errors import ConfigError, RecordError
from mavfi_cli.core.files import read_parquet
from mavfi_cli.mission.measures import measures_of, record_of
from mavfi_cli.spec.mission import MissionConfig

_COMPARED = frozenset(measures_of({})) | {"outcome"}


@dataclass(frozen=True, slots=True, kw_only=True)
class _CampaignMission:
    """A mission of a campaign, and the measures that it had."""

    config: MissionConfig
    row: Mapping[str, Any]

    def differing(self, result: Mapping[str, Any]) -> list[str]:
        """The columns in which a repetition differs; mixed columns of an export are text."""
        again = {**measures_of(result), "outcome": record_of(result).outcome}
        return [
            name
            for name, value in self.row.items()
            if name in _COMPARED and value != again[name] and str(value) != str(again[name])
        ]


def mission_of(campaign: Path, number: int) -> _CampaignMission:
    """One mission by its number.

    Args:
        campaign: its folder, or an exported .parquet file.

    Raises:
        RecordError: there is no campaign, or it cannot be read.
        ConfigError: no such mission has flown.
    """
    if campaign.is_file():
        return _of_export(campaign, number)
    with Ledger(campaign) as ledger:
        for entry in ledger.results([number]):
            if entry.outcome is not None:
                row = {**measures_of(entry.result), "outcome": entry.outcome}
                return _CampaignMission(config=entry.mission.config, row=row)
    raise _not_flown(campaign, number)


def _of_export(path: Path, number: int) -> _CampaignMission:
    table = read_parquet(path, "export of a campaign")
    if missing := {"number", "outcome", "changes"} - {*table.column_names}:
        told = f"no export of a campaign: it has no column {', '.join(sorted(missing))}"
        raise RecordError(f"{path}: {told}")
    for row in table.filter(pc.equal(table["number"], number)).to_pylist():
        if row["outcome"] is not None:
            config = structure(json.loads(row["changes"]), MissionConfig)
            return _CampaignMission(config=config, row=row)
    raise _not_flown(path, number)


def _not_flown(campaign: Path, number: int) -> ConfigError:
    return ConfigError(f"has no mission {number} that has flown", path=campaign)
