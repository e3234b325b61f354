"""A source-level flight loads no debugger."""

import subprocess
import sys

import pytest

FLIGHT = """
import sys
from pathlib import Path
from mavfi_cli.spec.mission import MissionConfig
from mavfi_cli.spec.fault import FaultConfig
from mavfi_cli.mission.progress import Watcher
from mavfi_cli.mission.run import fly_mission

config = MissionConfig(
    world="farm", seed=5, stack="hardened", start=(2.0, 2.0, 0.0), goal=(10.0, 6.0, 5.0),
    fault=FaultConfig(target="planning", seed=2),
)
fly_mission(config, Path(sys.argv[1]), Watcher())
import mavfi_cli.campaigns.run
print([name for name in sys.modules if name.startswith(("capstone", "mavfi_cli.fi.tracer.decode"))])
"""


@pytest.mark.slow
def test_a_source_level_flight_loads_no_debugger(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", FLIGHT, tmp_path], capture_output=True, text=True, check=False
    )
    assert (done.stdout.strip(), done.stderr) == ("[]", "")
    assert len(list(tmp_path.glob("farm-5-*/result.json"))) == 1


def test_what_a_user_asks_for_loads_no_debugger_and_no_planner():
    names = ("mission", "detector", "fault", "platform", "stack")
    load = ";".join(f"import mavfi_cli.spec.{name}" for name in names)
    heavy = ("capstone", "mavfi_cli.fi.tracer", "mavfi_cli.link", "ompl")
    code = f"import sys;{load};print([n for n in sys.modules if n.startswith({heavy})])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
