"""Fixtures of the tests of the paper."""

import os

import pytest

from mavfi_cli.paper import flying


@pytest.fixture
def no_vehicle(monkeypatch):
    """Let nothing start a vehicle, and let the workers find the task that flies nothing."""
    monkeypatch.setattr(flying, "check_kinds", lambda missions: None)
    folder = os.path.join(os.path.dirname(__file__), os.pardir, "campaigns")
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv("PYTHONPATH", folder)
