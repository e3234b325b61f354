"""The first flight on a machine: everything is compiled before the link opens."""

import json
import os
import subprocess
import sys

import pytest

FLIGHT = """
import json, sys
from numba.core import event
import mavfi_cli as mavfi
from mavfi_cli.mission import vehicle

class Late(event.Listener):
    kernels = []
    def on_start(self, told):
        self.kernels.append(told.data["dispatcher"].py_func.__name__)
    def on_end(self, told):
        pass

def opened(*given, **options):
    event.register("numba:compile", Late())
    return real(*given, **options)

real, vehicle.open_transport = vehicle.open_transport, opened
link, detector, out = sys.argv[1:]
run = mavfi.fly(
    link=link, detector={"name": detector}, goal=(8.0, 4.0, 5.0), stack="hardened", out=out
)
unused = [name for name, node in run.result["kernels"].items() if not node["invocations"]]
print(json.dumps({"unused": unused, "late": Late.kernels}))
"""


@pytest.mark.slow
def test_nothing_is_compiled_once_the_link_is_open(start_sitl, tmp_path):
    """The second flight finds what the first has compiled, but not the kernels of its detector."""
    cache = tmp_path / "cache"
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    compiled = set()
    for detector in ("gad", "aad"):
        with start_sitl() as link:
            done = subprocess.run(
                [sys.executable, "-c", FLIGHT, link, detector, str(tmp_path)],
                env=environment, stdout=subprocess.PIPE, check=True,
            )  # fmt: skip
        assert json.loads(done.stdout) == {"unused": [], "late": []}
        assert {*cache.rglob("*.nbc")} > compiled
        compiled = {*cache.rglob("*.nbc")}
