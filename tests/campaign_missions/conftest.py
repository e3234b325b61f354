"""Campaigns of missions that fly nothing, so that hundreds of them take a second."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest

from mavfi_cli.campaign.keep import Keep
from mavfi_cli.campaign.ledger import Ledger
from mavfi_cli.campaign.missions import PlannedMission
from mavfi_cli.campaign.outcome import Injected, State
from mavfi_cli.campaign.progress import Spectator
from mavfi_cli.campaign.run import Options, run_campaign
from mavfi_cli.mission.config import MissionConfig
from mavfi_cli.mission.fault_config import FaultConfig


@pytest.fixture(autouse=True)
def _fake_task_is_importable(monkeypatch):
    paths = [str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, paths)))


class Notes(Spectator):
    """Keeps what it is told."""

    def __init__(self):
        self.lines = []
        self.last = None

    def on_progress(self, progress):
        self.last = progress

    def on_note(self, text):
        self.lines.append(text)


class Campaign:
    """Runs lists of missions into one folder."""

    def __init__(self, folder):
        self.folder = folder
        self.notes = Notes()
        self.options = Options(jobs=2, keep=Keep.NONE, task="fake_task")

    def run(self, missions, *, append=False, stop=None, **options):
        changed = replace(self.options, **options)
        return run_campaign(missions, self.folder, changed, self.notes, append=append, stop=stop)


@pytest.fixture
def campaign(tmp_path):
    return Campaign(tmp_path / "campaign")


class Book:
    """Writes a ledger mission by mission."""

    def __init__(self, folder):
        self.ledger = Ledger(folder, writing=True)

    def add(self, labels, seed, time_s, *, injected=Injected.ACTIVE, outcome="success",
            config=None, path=None, record=None):  # fmt: skip
        """A flown mission, with what else its record says; its number."""
        fault = None if injected is Injected.GOLDEN else FaultConfig(target="control", seed=seed)
        number = self.ledger.planned()
        config = config or MissionConfig(seed=seed, fault=fault)
        mission = PlannedMission(config=config, labels=labels)
        self.ledger.plan([mission])
        quality = {"flight_time_s": time_s, "distance_m": 50.0, "energy_regression_j": 9e3}
        self.ledger.add(
            number, state=State.FLOWN, reason="", injected=injected, wall_s=1.0, attempts=1,
            path=path, result={
                "outcome": outcome, "quality_of_flight": quality, "pilot": {"replans": seed},
                **(record or {}),
            },
        )  # fmt: skip
        return number


@pytest.fixture
def book(tmp_path):
    written = Book(tmp_path / "campaign")
    yield written
    written.ledger.close()
