"""Missions and worlds that many tests fly, as Python, as a command line and as TOML."""

from mavfi_cli.core.types import KERNELS
from mavfi_cli.spec.mission import MissionConfig

# Some 20 simulated seconds, take-off included; less than a second of work.
SHORT = MissionConfig(
    world="farm", seed=5, stack="hardened", start=(2.0, 2.0, 0.0), goal=(10.0, 6.0, 5.0)
)
SHORT_LINE = ("fly", "--world", "farm", "--seed=5", "--start=2,2,0", "--goal=10,6,5")
SHORT_WAY = "[mission]\nstart = [2.0, 2.0, 0.0]\ngoal = [10.0, 6.0, 5.0]\n"
# What a flight leaves in its folder, beside a picture.
RECORD = {"result.json", "trace.parquet", "plans.parquet", "kernels.parquet", "flight.tlog"}
# A world whose straight way to the goal is blocked.
POSTS = (
    'name = "posts"\nbounds_enu_m = [-10.0, -20.0, 0.0, 40.0, 20.0, 20.0]\n'
    "start_enu_m = [0.0, 0.0, 0.0]\ngoal_enu_m = [20.0, 0.0, 5.0]\n"
    "[[box]]\nmin_enu_m = [9.0, -4.0, 0.0]\nmax_enu_m = [12.0, 3.0, 12.0]\n"
)
# A world without anything in the short way to the goal.
LAWN = (
    'name = "lawn"\nbounds_enu_m = [-10.0, -10.0, 0.0, 30.0, 20.0, 20.0]\n'
    "start_enu_m = [0.0, 0.0, 0.0]\ngoal_enu_m = [8.0, 4.0, 5.0]\n"
    "[[box]]\nmin_enu_m = [5.0, 9.0, 0.0]\nmax_enu_m = [8.0, 12.0, 9.0]\n"
)
# A platform's file with every kernel.
SOUND_PLATFORM = 'name = "mine"\ncores = 2\n' + "".join(
    f"[kernels.{kernel}]\nlatency_s = {0.01 * (k + 1):.2f}\nspread = 0.5\n"
    for k, kernel in enumerate(KERNELS)
)
