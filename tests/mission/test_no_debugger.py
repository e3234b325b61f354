"""A source-level flight loads no debugger."""

import subprocess
import sys

FLIGHT = """
import sys
from pathlib import Path
from mavfi_cli.mission.config import MissionConfig
from mavfi_cli.mission.fault_config import FaultConfig
from mavfi_cli.mission.progress import Watcher
from mavfi_cli.mission.run import fly_mission

config = MissionConfig(
    world="farm", seed=5, stack="hardened", start=(2.0, 2.0, 0.0), goal=(10.0, 6.0, 5.0),
    fault=FaultConfig(target="planning", seed=2),
)
fly_mission(config, Path(sys.argv[1]), Watcher())
import mavfi_cli.campaign.run
print([name for name in sys.modules if name.startswith(("capstone", "mavfi_cli.fi.tracer.arch"))])
"""


def test_a_source_level_flight_loads_no_debugger(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", FLIGHT, tmp_path], capture_output=True, text=True, check=False
    )
    assert (done.stdout.strip(), done.stderr) == ("[]", "")
    assert len(list(tmp_path.glob("farm-5-*/result.json"))) == 1
