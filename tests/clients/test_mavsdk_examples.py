"""MAVSDK-Python's own offboard examples, unchanged, as companions with faults.

MAVSDK_EXAMPLES names the folder `examples` of a clone of mavlink/MAVSDK-Python. The wheel does not
contain it.
"""

import os
import shutil
from pathlib import Path

import pytest

from mavfi_cli import library
from mavfi_cli.spec.fault import FaultConfig, InstructionConfig

RESULTS = Path(__file__).parents[2] / "docs" / "results"
EXAMPLES = os.environ.get("MAVSDK_EXAMPLES")
OPEN = """name = "open"
bounds_enu_m = [-200.0, -200.0, 0.0, 200.0, 200.0, 50.0]
start_enu_m = [0.0, 0.0, 0.0]
goal_enu_m = [0.0, 40.0, 5.0]
"""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not EXAMPLES, reason="MAVSDK_EXAMPLES names no folder"),
]


@pytest.fixture(params=["ours", "px4"])
def autopilot(request):
    if request.param == "px4" and not os.environ.get("PX4_SITL"):
        pytest.skip("PX4_SITL names no PX4")
    return request.param


@pytest.fixture(params=["velocity-ned", "velocity-body", "position-ned", "attitude"])
def example(request, tmp_path, autopilot):
    """Flies an example with the file of its campaign, but without the corridor."""
    name = f"offboard_{request.param.replace('-', '_')}.py"
    place = tmp_path / "MAVSDK-Python" / "examples" / name
    place.parent.mkdir(parents=True)
    shutil.copyfile(Path(EXAMPLES) / name, place)
    lines = (RESULTS / f"mavsdk-{request.param}.toml").read_text().splitlines()
    assert lines[-1].startswith("golden =")
    path = tmp_path / "first.toml"
    path.write_text("\n".join(lines[:-2]) + "\n")

    world = tmp_path / "open.toml"  # on PX4, the paths meet the hedges of farm
    world.write_text(OPEN)

    def fly(**fault):
        flown = library.fly(
            companion=str(path),
            autopilot=autopilot,
            world=str(world),
            time_limit_s=90.0,
            out=tmp_path,
            **fault,
        )
        return flown.record

    fly.attitude = request.param == "attitude"
    return fly


def test_it_flies_and_lands(example):
    record = example()
    assert (record.outcome, record.reason) == ("success", "fly ended with code 0")
    assert record.quality_of_flight.distance_m > 10.0


def test_an_instruction_of_its_server_is_struck(example):
    fault = InstructionConfig(target="fly/mavsdk_server", at="time=3", seed=2)
    struck = example(instruction=fault).instruction_fault
    assert struck.state == "applied"
    assert struck.node == "fly"


def test_a_setpoint_is_struck(example):
    message = "SET_ATTITUDE_TARGET.thrust" if example.attitude else "SET_POSITION_TARGET_LOCAL_NED"
    field = "" if example.attitude else ".type_mask"
    record = example(fault=FaultConfig(target=f"output.{message}{field}", seed=1))
    assert record.fault.state == "applied"
    assert record.strikes
