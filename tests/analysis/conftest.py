"""Ledgers and comparisons that nobody flew."""

import pytest
from flown_twice import whole  # noqa: F401

from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.campaigns.missions import Injected, PlannedMission, ResultState
from mavfi_cli.spec.fault import FaultConfig
from mavfi_cli.spec.mission import MissionConfig


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
            number, state=ResultState.FLOWN, reason="", injected=injected, wall_s=1.0, attempts=1,
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
