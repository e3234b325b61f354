"""docs/vpm.md: its files load, its numbers are what the commands print."""

import re
from pathlib import Path

import pytest

from mavfi_cli.spec.platform import load_platform, platform_names
from mavfi_cli.vpm.model import SCHEMES
from mavfi_cli.vpm.report import Choices, report
from mavfi_cli.vpm.vehicle import load_vehicle

TEXT = (Path(__file__).parents[2] / "docs" / "vpm.md").read_text()


def files():
    return re.findall(r"^```toml\n(.*?)^```$", TEXT, re.DOTALL | re.M)


def test_the_example_files_load_and_are_used(tmp_path):
    vehicle, platform = files()
    (tmp_path / "vehicle.toml").write_text(vehicle)
    (tmp_path / "platform.toml").write_text(platform)
    half = load_platform(str(tmp_path / "platform.toml"))
    (one,) = report(
        [load_vehicle(str(tmp_path / "vehicle.toml"))], Choices(platform=half), SCHEMES
    )["vehicles"]
    assert one["board"] == "half-tx2"
    assert one["schemes"][0]["compute_kg"] == pytest.approx(0.1 + 0.0054 * 20.0)


def test_the_table_of_platforms():
    rows = re.findall(r"^\| `([\w.-]+)` \| .* \| (\d+) ms \| (\d+) ms \|$", TEXT, re.M)
    assert sorted(name for name, _, _ in rows) == platform_names()
    for name, octomap_ms, planner_ms in rows:
        kernels = load_platform(name).kernels
        assert 1000.0 * kernels["octomap"].latency_s == pytest.approx(float(octomap_ms), abs=0.51)
        assert 1000.0 * kernels["planner"].latency_s == pytest.approx(float(planner_ms), abs=0.51)


def test_the_table_of_calibrations():
    rows = re.findall(r"^\| `(\w+)` \| [\w ]+ \| ([\d.]+) (s|N) \| x ([\d.]+) \| x ([\d.]+) \|$",
                      TEXT, re.M)  # fmt: skip
    assert [row[0] for row in rows] == ["airsim", "spark"]
    for name, value, unit, tmr, dmr in rows:
        (one,) = report([load_vehicle(name)], Choices(), SCHEMES)["vehicles"]
        found = one["calibrations"][0]
        assert (f"{found['value']:.3g}", found["unit"]) == (value, unit)
        assert f"{found['tmr_ratio']:.2f}" == tmr
        assert f"{found['predicted_dmr_ratio']:.3f}" == dmr
