"""Figures that are drawn from run folders: from a campaign that has kept them."""

from pathlib import Path

import pytest
from made_flights import export_table, flight

from mavfi_cli.analysis.pairs import Flights
from mavfi_cli.campaigns.missions import canonical, changes_of
from mavfi_cli.paper import document
from mavfi_cli.paper.items import BY_NAME, FlightsPlan
from mavfi_cli.paper.sources import CampaignSource, Evidence

FIG13 = BY_NAME["fig13"]
KINDS = FlightsPlan(items=[FIG13], stack="mavbench").kinds()


@pytest.fixture
def shown(monkeypatch, tmp_path):
    """What is shown of Fig. 13 on `mavbench`, and the run folders that are drawn."""
    monkeypatch.setattr(document, "ITEMS", [FIG13])
    monkeypatch.setattr(document, "draw", lambda *given: given[1]["path"])
    monkeypatch.setattr(document.Picture, "of", lambda *given: given[2])

    def of(*exports, path=tmp_path):
        tables = [Flights.of(each) for each in exports]
        campaigns = [
            CampaignSource(path=path, name="some", spec=None, planned=None, flights=each)
            for each in tables
        ]
        evidence = Evidence(campaigns=campaigns, kernels=[], problems=[])
        shown = document.document(evidence).items
        return next(each for item in shown for each in item.parts if each.place == "mavbench")

    return of


def export(seed, folder=None):
    """The missions of Fig. 13 with a seed, whose run folders are this one."""
    rows = []
    for mission in KINDS:
        changes = {**changes_of(mission.config), "seed": seed}
        level = "instruction" if mission.config.instruction else None
        rows.append(
            flight(
                20.0, pair=str(seed), stack="mavbench", world="dense", level=level,
                fault_target="planning" if level else None, changes=canonical(changes),
                path=None if folder is None else str(folder),
            )
        )  # fmt: skip
    return export_table(rows)


def test_the_campaign_that_kept_its_runs_is_drawn(shown, tmp_path):
    found = shown(export(1), export(2, tmp_path))
    assert found.picture == [str(tmp_path)] * len(KINDS)
    assert found.table is not None


def test_no_run_folder_is_read_because_an_export_names_it(shown, tmp_path):
    found = shown(export(2, tmp_path), path=Path("some.parquet"))
    assert found.picture is None
    assert found.table is not None


def test_without_run_folders_there_is_a_table_and_no_picture(shown, tmp_path):
    found = shown(export(1), export(2, tmp_path / "gone"))
    assert found.picture is None
    assert found.table is not None
