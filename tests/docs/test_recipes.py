"""The recipes of docs/how-to/eyes.md: every line in a terminal of its own, on free ports."""

import contextlib
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from test_code_blocks import ROOT, blocks

pytestmark = pytest.mark.slow
RECIPES = [
    block.text.replace("\\\n", " ").splitlines()
    for block in blocks(ROOT / "docs" / "how-to" / "eyes.md")
    if "test_recipes.py" in block.notes.get("not run", "")
]
QUICK = ["--stack", "hardened", "--no-picture", "--quiet", "--expect", "success"]
NEAR = "--goal=62,24,5"  # in the farm, whose start is 10 m south
PORTS = ("14540", "14600", "5760", "5762")
LONG_S = 240.0


def free_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return str(probe.getsockname()[1])


class Terminals:
    """Runs the lines of a recipe in a folder, each as a process."""

    def __init__(self, folder, running):
        self._folder, self._running = folder, running
        self._ports = {port: free_port() for port in PORTS}

    def words(self, line):
        line = re.sub("|".join(PORTS), lambda found: self._ports[found[0]], line)
        program, *rest = shlex.split(line)
        if program == "mavfi":
            program, rest = sys.executable, ["-m", "mavfi_cli", *rest]
            if rest[2] == "sitl":
                rest += ["--link", f"onboard=udpout:127.0.0.1:{self._ports['14540']}", "--speed=2"]
        elif program == "arducopter":
            base = int(self._ports["5760"])
            self._ports["5762"] = str(base + 2)
            program, rest = os.environ["ARDUCOPTER_SITL"], [*rest, "-w", "--base-port", str(base)]
        return [sys.executable if program == "python" else program, *rest]

    def start(self, line):
        process = subprocess.Popen(
            self.words(line), cwd=self._folder, start_new_session=True,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        self._running.callback(process.wait)
        self._running.callback(process.send_signal, signal.SIGINT)

    def finish(self, line, *more):
        return subprocess.run(
            [*self.words(line), *QUICK, *more], cwd=self._folder, check=False, timeout=LONG_S,
            capture_output=True, text=True,
        )  # fmt: skip


@pytest.mark.parametrize("recipe", RECIPES, ids=lambda lines: lines[-1])
def test_a_recipe_reaches_the_goal(recipe, tmp_path):
    if recipe[0].startswith("arducopter"):
        if not {"ARDUCOPTER_SITL", "ARDUCOPTER_PARM"} <= os.environ.keys():
            pytest.skip("ARDUCOPTER_SITL and ARDUCOPTER_PARM do not name ArduCopter")
        shutil.copy(os.environ["ARDUCOPTER_PARM"], tmp_path / "copter.parm")
    *others, flight = recipe
    with contextlib.ExitStack() as running:
        terminals = Terminals(tmp_path, running)
        for line in others:
            if line.startswith("echo"):
                subprocess.run(line, shell=True, cwd=tmp_path, check=True)
            else:
                terminals.start(line)
        flown = terminals.finish(flight, *([NEAR] if "farm" in " ".join(others) else []))
    assert flown.returncode == 0, (flown.stdout, flown.stderr)
    assert ("autopilot's own pose" in flown.stdout) == ("--eyes" in flight)
    assert Path(tmp_path, "runs").is_dir()


def test_every_recipe_is_found():
    assert len(RECIPES) == 4
