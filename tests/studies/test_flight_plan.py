"""What a row of the model becomes in the simulator."""

import re
import tomllib
from pathlib import Path

import pytest

from mavfi_cli.core.errors import CannotLift
from mavfi_cli.spec.platform import load_platform
from mavfi_cli.studies.redundancy import FlightPlan, RedundancyPlan
from mavfi_cli.vpm.model import SCHEMES, Board, ModelVehicle, hover_power_w
from mavfi_cli.vpm.report import Choices

X86 = load_platform("x86")
SUM_S = sum(kernel.latency_s for kernel in X86.kernels.values())


@pytest.fixture
def plan(tmp_path):
    def of(vehicle, scheme, choices=None, platform=X86, chain_s=SUM_S):
        setting = (choices or Choices()).inputs(ModelVehicle.load(vehicle))
        return FlightPlan.of(setting, SCHEMES[scheme], platform, chain_s, tmp_path), setting

    return of


def files_of(plan):
    plan.write()
    mission = plan.mission
    return [tomllib.loads(Path(path).read_text()) for path in (mission.vehicle, mission.platform)]


@pytest.mark.parametrize("scheme", ["none", "dmr", "tmr"])
def test_mass_pull_and_velocity_are_the_model_s(plan, scheme):
    planned, setting = plan("spark", scheme)
    flown = setting.performance(SCHEMES[scheme])
    mass_kg = setting.mass_kg(SCHEMES[scheme].copies)
    vehicle, _ = files_of(planned)
    assert vehicle["base"] == "spark"
    assert vehicle["mass_kg"] + vehicle["extra_payload_kg"] == pytest.approx(mass_kg)
    assert vehicle["rotor_pull_n"] == setting.pull_n
    assert planned.mission.v_max_mps == flown.velocity_mps
    assert planned.mission.a_max_mps2 == pytest.approx(min(flown.acceleration_mps2, 8.0))
    assert planned.mission.map_range_m == 7.0
    assert planned.mission.camera_rate_hz == 30.0
    assert planned.mission.detector is None
    assert planned.setup.boards_w == 10.0 * SCHEMES[scheme].copies
    assert planned.setup.rotors_w == pytest.approx(hover_power_w(63.0, 0.3, mass_kg))
    assert vehicle["avionics_w"] == planned.setup.boards_w


def test_the_stack_is_the_mission_s(tmp_path):
    setting = Choices().inputs(ModelVehicle.load("spark"))
    arguments = (setting, SCHEMES["none"], X86, SUM_S, tmp_path)
    assert FlightPlan.of(*arguments).mission.stack == "mavbench"
    assert FlightPlan.of(*arguments, stack="hardened").mission.stack == "hardened"


def test_what_a_mission_cannot_take_is_told(plan):
    planned, _ = plan("spark", "none")
    (cut,) = planned.setup.cut
    assert re.fullmatch(r"acceleration 8 m/s² .* 9\.171 m/s²", cut)
    assert plan("spark", "tmr")[0].setup.cut == ()
    fast, _ = plan("cal20", "none", Choices(response_s=0.01, board=Board.load("ncs")))
    assert fast.mission.v_max_mps == 12.0
    assert fast.setup.cut[0].startswith("velocity 12 m/s instead of ")
    assert re.fullmatch("sensor rate 50 Hz .* 60 Hz", fast.setup.cut[-1])


@pytest.mark.parametrize("scheme", ["none", "tmr", "gad", "aad"])
def test_the_platform_takes_the_model_s_response_time(plan, scheme):
    planned, setting = plan("airsim", scheme)
    _, platform = files_of(planned)
    overhead = SCHEMES[scheme].overhead
    taken_s = sum(kernel["latency_s"] for kernel in platform["kernels"].values())
    assert taken_s == pytest.approx(setting.compute_s * (1.0 + overhead))
    loaded = load_platform(planned.mission.platform)
    assert loaded.cores == X86.cores
    assert loaded.kernels["octomap"].spread == X86.kernels["octomap"].spread
    detector = planned.mission.detector
    assert (detector and detector.name) == (scheme if scheme in ("gad", "aad") else None)


def test_a_named_platform_flies_as_it_is(plan):
    tx2 = load_platform("tx2")
    chain_s = sum(kernel.latency_s for kernel in tx2.kernels.values())
    planned, _ = plan("airsim", "none", Choices(platform=tx2), tx2, chain_s)
    planned.write()
    flown = load_platform(planned.mission.platform).kernels
    for name, kernel in tx2.kernels.items():
        assert flown[name].latency_s == pytest.approx(kernel.latency_s)


def test_equal_names_are_equal_flights(plan):
    first, second = plan("spark", "none")[0], plan("spark", "none")[0]
    assert first.mission == second.mission
    other, _ = plan("spark", "none", Choices(response_s=0.5))
    assert other.mission.vehicle != first.mission.vehicle or (
        other.mission.platform != first.mission.platform
    )


def test_what_cannot_be_lifted_has_no_plan(plan):
    with pytest.raises(CannotLift, match=r"cannot lift its compute: 8\.33 N"):
        plan("spark", "tmr", Choices(board=Board.load("xavier")))


def test_the_list_grows_pair_by_pair(plan, tmp_path):
    ask = RedundancyPlan(
        vehicles=(), choices=Choices(), worlds=("sparse", "dense"), missions=2, first_seed=5,
        folder=tmp_path,
    )  # fmt: skip
    missions = ask.missions_of(
        {("spark", name): plan("spark", name)[0] for name in ("none", "tmr")}
    )
    assert [(m.config.seed, m.config.world, m.labels["arm"]) for m in missions] == [
        (5, "sparse", "none"), (5, "sparse", "tmr"), (5, "dense", "none"), (5, "dense", "tmr"),
        (6, "sparse", "none"), (6, "sparse", "tmr"), (6, "dense", "none"), (6, "dense", "tmr"),
    ]  # fmt: skip
    pairs = [mission.pair for mission in missions]
    assert pairs[0] == pairs[1] == "sparse/5"
    assert len(set(pairs)) == 4
