"""Two reports of users: a dead script with a living server, and a single wild setpoint.

A script on MAVSDK dies, and its `mavsdk_server` goes on sending the last setpoint
(mavlink/MAVSDK-Python 374 and 741). One velocity of -1000 m/s is flown (PX4/PX4-Autopilot 27611).
"""

import os
import sys
from pathlib import Path

import pytest
from made_flights import companion_gate

from mavfi_cli import library
from mavfi_cli.spec.fault import InstructionConfig

SCRIPT = Path(__file__).with_name("mavsdk_offboard.py")


@pytest.fixture(params=["ours", "px4"])
def fly(request, tmp_path):
    """Flies the script with a fault, and with or without a gate that knows speeds up to 3 m/s."""
    if request.param == "px4" and not os.environ.get("PX4_SITL"):
        pytest.skip("PX4_SITL names no PX4")
    path = tmp_path / "script.toml"

    def flown(fault, *, threshold=None, time_limit_s=25.0, instruction=None, action="hold"):
        path.write_text(
            f"[program.script]\ncommand = '{sys.executable} {SCRIPT} {{mavsdk}} {{free}}'\n"
            f"environment = {{ FAULT = '{fault}', WILD_S = '3' }}\n[success]\nlanded = true\n"
            f"[gate]\naction = '{action}'\n"
        )
        detector = None
        if threshold is not None:
            detector = companion_gate(path, threshold)
        return library.fly(
            companion=str(path), world="farm", seed=1, time_limit_s=time_limit_s, out=tmp_path,
            autopilot=request.param, detector=detector, instruction=instruction,
        )  # fmt: skip

    return flown


@pytest.mark.slow
def test_the_server_of_a_dead_script_flies_on_until_the_gate_withholds_what_no_longer_changes(fly):
    unguarded = fly("dies")
    assert unguarded.record.outcome == "timeout"  # nobody has noticed
    assert not any("ailsafe" in event.text for event in unguarded.record.events)
    guarded = fly("dies", threshold=1e6)  # only silence counts here
    assert guarded.record.outcome == "crash"
    texts = [event.text for event in guarded.record.events]
    assert any("program script is gone" in text for text in texts)
    assert any("failsafe" in text for text in texts)
    assert guarded.record.detection.responses["stale"] >= 1


@pytest.mark.slow
def test_the_gate_withholds_a_wild_setpoint(fly):
    assert fastest_mps(fly("wild")) > 6.0
    guarded = fly("wild", threshold=0.5, time_limit_s=60.0)
    assert guarded.record.outcome == "success"
    assert fastest_mps(guarded) < 3.0
    assert guarded.record.detection.alarm_count >= 1
    assert guarded.record.detection.responses["hold"] >= 1
    assert guarded.record.detection.responses["brake"] >= 1


@pytest.mark.slow
def test_the_autopilot_holds_and_the_script_waits(fly):
    guarded = fly("wild", threshold=0.5, action="autopilot")
    assert guarded.record.outcome == "timeout"  # the script does not switch back to OFFBOARD
    assert fastest_mps(guarded) < 3.0
    assert guarded.record.detection.responses["autopilot"] >= 1
    texts = [event.text for event in guarded.record.events]
    assert "AUTO.LOITER" in texts[texts.index("OFFBOARD") :]


@pytest.mark.slow
def test_an_instruction_of_the_server_is_struck(fly):
    fault = InstructionConfig(target="script/mavsdk_server", at="time=3", seed=2)
    record = fly("", time_limit_s=60.0, instruction=fault).record
    assert record.outcome in ("success", "crash", "failsafe", "timeout")
    assert record.instruction_fault.state == "applied"
    assert record.instruction_fault.node == "script"
    assert record.instruction_fault.object


def fastest_mps(run):
    return run.record.quality_of_flight.max_speed_mps
