"""Campaigns of missions that fly nothing, so that hundreds of them take a second."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest

from mavfi_cli.campaigns.progress import Spectator
from mavfi_cli.campaigns.run import Options, run_campaign
from mavfi_cli.campaigns.specification import Keep


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
