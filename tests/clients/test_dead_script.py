"""The dead script with the living server: mavlink/MAVSDK-Python issues 374 and 741.

A script on MAVSDK dies, and its `mavsdk_server` goes on sending the last setpoint.
"""

import sys
from pathlib import Path

import numpy as np
import pytest

from mavfi_cli import library
from mavfi_cli.core.types import Command
from mavfi_cli.detect.fit import fit
from mavfi_cli.detect.offline import Dataset, FlightSamples
from mavfi_cli.detect.preprocess import PreprocessParams
from mavfi_cli.spec.companion import CompanionConfig
from mavfi_cli.spec.detector import DetectorConfig

SCRIPT = Path(__file__).with_name("mavsdk_offboard.py")


@pytest.fixture
def companion(tmp_path):
    path = tmp_path / "script.toml"
    path.write_text(
        f"[program.script]\ncommand = '{sys.executable} {SCRIPT} {{mavsdk}} {{free}}'\n"
        "environment = { FAULT = 'dies' }\n[success]\nlanded = true\n"
    )
    return path


@pytest.fixture
def detector(companion, tmp_path):
    """A detector of this companion that raises no alarm: only silence counts here."""

    def flight(seed):
        still = Command(stamp_s=0.0, velocity_enu_mps=np.zeros(3), yaw_rad=0.0)
        return FlightSamples.of_ticks(((0.1 * n, None, still) for n in range(9)), "farm", seed)

    mark = CompanionConfig.load(str(companion)).mark
    dataset = Dataset(
        flights=tuple(map(flight, range(10))), preprocess=PreprocessParams(), stack=mark
    )
    fit("range", dataset).save(tmp_path / "range.json")
    return DetectorConfig(name="range", model=str(tmp_path / "range.json"), threshold=1e6)


@pytest.mark.slow
def test_the_server_flies_on_until_the_gate_withholds_what_no_longer_changes(
    companion, detector, tmp_path
):
    def fly(**settings):
        return library.fly(
            companion=str(companion), world="farm", seed=1, time_limit_s=25.0, out=tmp_path,
            **settings,
        )  # fmt: skip

    unguarded = fly()
    assert unguarded.record.outcome == "timeout"  # nobody has noticed
    assert not any("ailsafe" in event.text for event in unguarded.record.events)
    guarded = fly(detector=detector)
    assert guarded.record.outcome == "crash"
    texts = [event.text for event in guarded.record.events]
    assert any("program script is gone" in text for text in texts)
    assert any("failsafe" in text for text in texts)
    assert guarded.record.detection.responses["stale"] >= 1
