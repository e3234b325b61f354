"""The pymavlink script of "Your companion", on mavfi's own vehicle and on PX4."""

import os
import sys

import pytest
from pages import block

from mavfi_cli import library


@pytest.mark.slow
@pytest.mark.parametrize("autopilot", ["ours", "px4"])
def test_the_script_of_your_companion_climbs_flies_north_and_lands(autopilot, tmp_path):
    if autopilot == "px4" and not os.environ.get("PX4_SITL"):
        pytest.skip("PX4_SITL names no PX4")
    (tmp_path / "hop.py").write_text(block("../your-companion", "python"))
    companion = tmp_path / "hop.toml"
    companion.write_text(
        f"[program.hop]\ncommand = '{sys.executable} hop.py {{link}}'\n[success]\nlanded = true\n"
    )
    run = library.fly(
        companion=str(companion), autopilot=autopilot, world="farm", time_limit_s=60.0, out=tmp_path
    )
    assert (run.record.outcome, run.record.reason) == ("success", "landed")
    assert run.record.quality_of_flight.distance_m > 14.0  # up, 10 m north, and down
