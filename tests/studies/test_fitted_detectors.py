"""Detectors that are fitted to the flights of a vehicle before `mavfi vpm --fly` flies it."""

import pytest

from mavfi_cli.campaigns.progress import Spectator
from mavfi_cli.campaigns.run import Options
from mavfi_cli.spec.platform import load_platform
from mavfi_cli.studies import redundancy
from mavfi_cli.studies.redundancy import FlightPlan, RedundancyPlan
from mavfi_cli.vpm.model import SCHEMES, ModelVehicle
from mavfi_cli.vpm.report import Choices


@pytest.fixture
def ask(tmp_path):
    def of(train):
        return RedundancyPlan(
            vehicles=[ModelVehicle.load("spark")], choices=Choices(), worlds=("sparse",),
            missions=1, first_seed=1, folder=tmp_path, train=train,
        )  # fmt: skip

    return of


@pytest.fixture
def bare(tmp_path):
    setting = Choices().inputs(ModelVehicle.load("spark"))
    return FlightPlan.of(setting, SCHEMES["none"], load_platform("x86"), 0.39, tmp_path)


def test_they_are_fitted_once_to_the_bare_vehicle_s_flights(ask, bare, monkeypatch):
    calls = []

    def train(plan, folder, _options, _spectator):
        calls.append(plan)
        folder.mkdir(parents=True)
        for kind in plan.kinds:
            (folder / f"{kind}.json").write_text("{}")

    monkeypatch.setattr(redundancy, "train", train)
    folder = redundancy.fitted(ask(3), "spark", bare, Options(), Spectator())
    (plan,) = calls
    assert plan.base == bare.mission
    assert plan.kinds == ("gad", "aad")
    missions = plan.missions()
    assert len(missions) == 12
    assert {mission.config.v_max_mps for mission in missions} == {bare.mission.v_max_mps}
    assert redundancy.fitted(ask(3), "spark", bare, Options(), Spectator()) == folder
    assert len(calls) == 1  # what is there is taken
    assert redundancy.fitted(ask(4), "spark", bare, Options(), Spectator()) != folder
    assert len(calls) == 2


def test_flights_name_the_fitted_models(tmp_path):
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "aad.json").touch()
    setting = Choices().inputs(ModelVehicle.load("spark"))
    planned = FlightPlan.of(
        setting, SCHEMES["aad"], load_platform("x86"), 0.39, tmp_path, tmp_path / "models"
    )
    assert planned.mission.detector.model == str(tmp_path / "models" / "aad.json")
