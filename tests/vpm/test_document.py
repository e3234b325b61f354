"""The pages about redundancy: their files load, their numbers are what the commands print."""

import re
from pathlib import Path

import pytest

from mavfi_cli.spec.platform import load_platform
from mavfi_cli.vpm.model import SCHEMES, ModelVehicle
from mavfi_cli.vpm.report import Choices, report

DOCS = Path(__file__).parents[2] / "docs"


def file_of(page, name):
    return re.findall(rf"<!-- file: {name} -->\n```toml\n(.*?)^```$", page.read_text(), re.S | re.M)


def test_the_example_files_load_and_are_used(tmp_path):
    (vehicle,) = file_of(DOCS / "how-to" / "redundancy.md", "my_vehicle.toml")
    (platform,) = file_of(DOCS / "how-to" / "platform.md", "half-tx2.toml")
    (tmp_path / "vehicle.toml").write_text(vehicle)
    (tmp_path / "platform.toml").write_text(platform)
    half = load_platform(str(tmp_path / "platform.toml"))
    (one,) = report(
        [ModelVehicle.load(str(tmp_path / "vehicle.toml"))], Choices(platform=half), SCHEMES
    ).vehicles
    assert one.board == "half-tx2"
    assert one.schemes[0].compute_kg == pytest.approx(0.1 + 0.0054 * 20.0)


def test_the_table_of_calibrations():
    text = (DOCS / "explanation" / "performance-model.md").read_text()
    rows = re.findall(r"^\| `(\w+)` \| [\w ]+ \| ([\d.]+) (s|N) \| x ([\d.]+) \| x ([\d.]+) \|$",
                      text, re.M)  # fmt: skip
    assert [row[0] for row in rows] == ["airsim", "spark"]
    for name, value, unit, tmr, dmr in rows:
        (one,) = report([ModelVehicle.load(name)], Choices(), SCHEMES).vehicles
        found = one.calibrations[0]
        assert (f"{found.value:.3g}", found.unit) == (value, unit)
        assert f"{found.tmr_ratio:.2f}" == tmr
        assert f"{found.predicted_dmr_ratio:.3f}" == dmr
