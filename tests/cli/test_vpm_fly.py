"""`mavfi vpm --fly` on a short way: flown once, read many times."""

import csv
import json
import re
import xml.etree.ElementTree as ET

import pytest
from missions import LAWN
from test_vpm import COUNTS, SVG, UNITS, numbers

COUNTED = {*COUNTS, "missions_each", "first_seed", "missions", "flights", "alarms", "success",
           "collision", "timeout", "no_path", "pairs", "pairs_over_aad", "flight_replans",
           "flight_alarms"}  # fmt: skip
LINE = ("vpm", "--fly", "--vehicle", "spark", "--world", "lawn.toml", "--missions", "1",
        "--out", "out", "--jobs", "2")  # fmt: skip


@pytest.fixture
def lawn(tmp_path):
    (tmp_path / "lawn.toml").write_text(LAWN)


@pytest.mark.slow
def test_model_and_flight_side_by_side(command_line, tmp_path, lawn):
    """One command: the table, the files, the same once more without flying."""
    code, out, err = command_line(*LINE)
    assert code == 0, err
    assert "== spark flown, board a57 ==" in out
    assert "Flight time over aad" in out
    folder = tmp_path / "out"
    told = json.loads((folder / "vpm.json").read_text())
    rows = {row["scheme"]: row for row in told["flights"]["vehicles"][0]["schemes"]}
    assert list(rows) == ["none", "dmr", "tmr", "gad", "aad"]
    for row in rows.values():
        assert row["outcomes"] == {"success": 1}
        assert row["flight_top_velocity_mps"] <= 1.05 * row["v_max_mps"]
    times = [rows[name]["flight_flight_time_s"] for name in ("none", "dmr", "tmr")]
    assert times == sorted(times)
    energies = [rows[name]["flight_energy_j"] for name in ("none", "dmr", "tmr")]
    assert energies == sorted(energies)
    _flown_as_planned(told, rows)
    _like_beside_like(rows)
    _units(told)
    _files(folder, rows)
    before = {path: path.read_bytes() for path in folder.glob("*.*")}
    code, again, err = command_line(*LINE, "--quiet")
    assert (code, again, err) == (0, out, "")
    assert {path: path.read_bytes() for path in folder.glob("*.*")} == before
    code, summary, err = command_line("campaign", "run", "out/flights", "--quiet")
    assert (code, err) == (0, "")
    assert "flights: 5 of 5 missions" in summary
    overhead = command_line("vpm", "--vehicle", "spark", "--overhead", "out", "--full")[1]
    assert re.search(r"1 flight of out on x86 x [\d.]+: ", overhead)


def _like_beside_like(rows):
    """The model beside a flight has the overhead with which it was flown, not the measured one."""
    assert rows["gad"]["overhead_percent"] == pytest.approx(2.2223)
    for row in rows.values():
        assert row["model_velocity_mps"] == pytest.approx(row["v_max_mps"])


def _flown_as_planned(told, rows):
    """The simulator says what it flew: the model's mass, and momentum theory's hover power."""
    model = {row["scheme"]: row for row in told["vehicles"][0]["schemes"]}
    for name, row in rows.items():
        assert row["mass_kg"] == model[name]["mass_kg"]
    shaft = [rows[name]["flight_hover_shaft_w"] for name in ("none", "tmr")]
    masses = [rows[name]["mass_kg"] for name in ("none", "tmr")]
    assert shaft[1] / shaft[0] == pytest.approx((masses[1] / masses[0]) ** 1.5)
    used = {each["detector"]: each["measured_percent"] for each in told["flights"]["overheads"]}
    assert set(used) == {"gad", "aad"}
    for name, percent in used.items():
        assert model[name]["overhead_percent"] == pytest.approx(percent)
        assert "1 flight of --fly on x86 x " in model[name]["source"]


def _units(told):
    keys = set(numbers(told["flights"]))
    assert "flight_velocity_mps" in keys
    assert [key for key in keys if key not in COUNTED and not key.endswith(UNITS)] == []


def _files(folder, rows):
    text = list(csv.DictReader((folder / "flights.csv").read_text().splitlines()))
    assert [row["scheme"] for row in text] == list(rows)
    assert float(text[2]["flight_flight_time_s"]) == rows["tmr"]["flight_flight_time_s"]
    words = " ".join(
        text.text or "" for text in ET.parse(folder / "flights.svg").getroot().iter(f"{SVG}text")
    )
    assert "100 % of 1 succeed" in words
    assert "spark: ratios, model and flight" in words


@pytest.mark.slow
def test_what_cannot_be_lifted_is_a_row(command_line, tmp_path, lawn):
    """Three boards by the model, two by the simulator, which needs thrust to steer."""
    (tmp_path / "board.toml").write_text(
        'name = "heavy"\nmass_kg = 0.2\npower_w = 0.0\nheatsink_kgpw = 0.0\n'
    )
    (tmp_path / "weak.toml").write_text(
        'name = "weak"\nmass_kg = 0.3\nrotor_pull_n = 7.5\nrange_m = 7.0\nsensor_hz = 30.0\n'
        "hover_power_w = 63.0\nbattery_wh = 16.0\nresponse_s = 0.3\n"
    )
    code, out, err = command_line(
        "vpm", "--fly", "--vehicle", "weak.toml", "--board", "board.toml", "--world", "lawn.toml",
        "--missions", "1", "--out", "out", "--quiet",
    )  # fmt: skip
    assert (code, err) == (0, "")
    assert re.search("tmr: not flown: .*'weak' .* 7.50 N", out)
    assert re.search(r"dmr: not flown: .* 7.5 N .* 0.3 kg \+ 0.4 kg .*at least 1.15", out)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--vehicle", "heavy.toml", "--board", "a57"), "vehicle 'heavy' cannot lift"),
        (("--vehicle", "mine.toml"), "mean 'spark'"),
        (("--world", "sprase"), "'sprase'.* 'sparse'"),
        (("--world", "sparse", "--world", "sparse"), "--world: must not name sparse twice"),
        (("--vehicle", "spark", "--vehicle", "spark"), "--vehicle: must not name spark twice"),
        (("--vehicle", "sparck"), "'sparck'.* 'spark'"),
        (("--train", "1", "--first-seed", "10003"), "10000 to 10003 are reserved for training"),
        (("--platform", "measured:2"), "--platform: measured:2 "),
    ],
)
def test_bad_input_of_flights_is_one_line(command_line, tmp_path, lawn, arguments, said):
    base = (
        "range_m = 7.0\nsensor_hz = 30.0\nhover_power_w = 63.0\nbattery_wh = 16.0\n"
        'response_s = 0.3\nboard = "a57"\nmass_kg = 0.3\n'
    )
    (tmp_path / "heavy.toml").write_text(f'name = "heavy"\nrotor_pull_n = 3.0\n{base}')
    (tmp_path / "mine.toml").write_text(
        f'name = "mine"\nrotor_pull_n = 8.0\nflies_as = "sparc"\n{base}'
    )
    worlds = () if "--world" in arguments else ("--world", "lawn.toml")
    vehicles = () if "--vehicle" in arguments else ("--vehicle", "spark")
    code, out, err = command_line("vpm", "--fly", *arguments, *worlds, *vehicles, "--out", "out")
    assert (code, out) == (2 if said.startswith(("'sp", "--")) else 1, "")
    (line,) = err.splitlines()
    assert line.startswith("error: ")
    assert re.search(said, line)


@pytest.mark.parametrize(
    "arguments",
    [("--missions", "3"), ("--world", "sparse"), ("--stack", "hardened"), ("--train", "2"),
     ("--quiet",), ("--jobs", "1"), ("--fly", "--missions", "0"),
     ("--fly", "--models", ".", "--train", "1")],
)  # fmt: skip
def test_usage_of_flights(command_line, arguments):
    code, out, err = command_line("vpm", *arguments)
    assert (code, out) == (2, "")
    assert err.startswith("error: ")
    assert len(err.splitlines()) == 1
