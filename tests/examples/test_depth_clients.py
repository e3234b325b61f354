"""Both depth clients of the examples read the frames of a flight."""

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from mavfi_cli import library

ROOT = Path(__file__).parents[2]
CLIENT = ROOT / "examples" / "depth_client"
HOP = ROOT / "tests" / "mission" / "hop.py"
SPEED, FRAMES = 4.0, 100


def python(_):
    return f"{sys.executable} {CLIENT.with_suffix('.py')}"


def cpp(folder):
    if shutil.which("g++") is None:
        pytest.skip("g++ is not installed")
    program = folder / "client"
    subprocess.run(
        ["g++", "-Wall", "-Wextra", "-Werror", "-o", program, CLIENT.with_suffix(".cpp")],
        check=True,
    )
    return str(program)


@pytest.mark.slow
@pytest.mark.parametrize("client", [python, cpp])
def test_a_client_reads_the_frames_of_a_flight(tmp_path, client):
    companion = tmp_path / "hop.toml"
    companion.write_text(
        f"[program.eyes]\ncommand = '{client(tmp_path)} {{camera}} {FRAMES}'\n"
        f"[program.hop]\ncommand = '{sys.executable} {HOP} {{link}} {SPEED} lands'\n"
        "[success]\nlanded = true\nexit = 'eyes'\n"
    )
    run = library.fly(
        companion=str(companion),
        world="farm",
        speed=SPEED,
        time_limit_s=60.0,
        out=tmp_path / "runs",
    )
    assert run.record.outcome == "success"
    told = (run.folder.programs / "eyes" / "stdout").read_text().splitlines()
    assert len(told) == FRAMES
    words = np.array([line.replace(" m, at", "").split() for line in told], dtype=float)
    assert (words[:, 1:3] == [48, 64]).all()
    steps_us = np.diff(words[:, 0])
    assert (steps_us > 0).all()
    assert (steps_us % 100_000 == 0).all()  # a busy machine may drop frames
    nearest_m, place_enu_m = words[:, 3], words[:, 4:]
    stamps_s = run.trace["stamp_s"].to_numpy()
    flown = [
        np.interp(words[:, 0] * 1e-6, stamps_s, run.trace[f"truth_{axis}_m"].to_numpy())
        for axis in "xyz"
    ]
    assert np.abs(place_enu_m - np.column_stack(flown)).max() < 0.3  # of the lens
    on_ground, climbed = place_enu_m[:, 2] < 0.2, place_enu_m[:, 2] > 2.0
    assert nearest_m[on_ground].max() < 1.0  # the ground just ahead
    assert climbed.any()
    assert nearest_m[climbed].min() > 1.0
