"""`mavfi vpm` and `mavfi platforms`: tables, JSON, CSV, pictures, and what is refused."""

import csv
import json
import re
import xml.etree.ElementTree as ET

import pytest

SVG = "{http://www.w3.org/2000/svg}"


def test_the_table_is_the_paper_s_figure(command_line):
    code, out, err = command_line("vpm")
    assert (code, err) == (0, "")
    assert "== airsim: AirSim UAV" in out
    assert "== spark: DJI Spark" in out
    told = [re.split("  +", line.strip()) for line in out.splitlines()]
    head = ["board", "a copy", "calibrated", "TMR", "paper's TMR", "DMR, predicted"]
    assert told.count(head) == 2
    assert ["a57", "139 g", "response_s = 0.8175 s", "x 1.0600", "x 1.06", "x 1.0287"] in told
    assert ["a57", "139 g", "rotor_pull_n = 8.331 N", "x 1.9100", "x 1.91", "x 1.2959"] in told


def test_notes_stand_above_the_tables(command_line):
    _, out, _ = command_line("vpm", "--vehicle", "spark", "--board", "raspi3b", "--overhead",
                             "aad=0.1")  # fmt: skip
    notes = [line for line in out.splitlines() if line.startswith("Note: ")]
    assert len(notes) == 3
    assert "overhead of gad" in notes[0]
    assert "board is raspi3b" in notes[1]
    assert out.index(notes[2]) < out.index("scheme  overhead")
    assert "number  " not in out
    assert out.rstrip().split("\n")[-1].startswith("--full prints ")


def test_csv_and_json_say_the_same(command_line, tmp_path):
    _, out, _ = command_line("vpm", "--csv")
    rows = list(csv.DictReader(out.splitlines()))
    told = json.loads(command_line("vpm", "--json")[1])
    flat = [(one["vehicle"], row) for one in told["vehicles"] for row in one["schemes"]]
    assert len(rows) == len(flat) == 10
    for row, (vehicle, same) in zip(rows, flat, strict=True):
        assert (row["vehicle"], row["scheme"]) == (vehicle, same["scheme"])
        assert float(row["flight_time_s"]) == same["flight_time_s"]
        assert float(row["energy_ratio"]) == same["energy_ratio"]


UNITS = ("_kg", "_n", "_m", "_s", "_hz", "_w", "_j", "_wh", "_deg", "_mps", "_mps2", "_kgpw",
         "_ratio", "_percent")  # fmt: skip
COUNTS = {"boards", "missions", "thrust_to_weight"}  # these have no unit


def numbers(value, key=""):
    if isinstance(value, dict):
        for name, item in value.items():
            if name == "value":
                assert value["unit"], value
            else:
                yield from numbers(item, key if name.isdecimal() else name)
    elif isinstance(value, list):
        for item in value:
            yield from numbers(item, key)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield key


def test_every_number_of_the_json_has_its_unit(command_line):
    told = json.loads(command_line("vpm", "--json")[1])
    for one in told["vehicles"]:
        for row in one["sensitivity"]:
            row["points"] = [{**point, "unit": row["unit"]} for point in row["points"]]
    keys = set(numbers(told))
    assert {"velocity_mps", "energy_j", "missions"} <= keys
    assert [key for key in keys if key not in COUNTS and not key.endswith(UNITS)] == []


def test_every_number_of_the_table_has_its_unit(command_line):
    """In each row of a scheme, only its boards are a count without a word; rows fit a terminal."""
    _, out, _ = command_line("vpm", "--vehicle", "spark", "--full")
    unit = r"(?:%|kg|N/N|m/s²|m/s|Hz|s|W|kJ|missions)(?= |$)"
    found = [line for line in out.splitlines() if re.match(r"(none|dmr|tmr|gad|aad) ", line)]
    assert len(found) == 15
    for place, line in enumerate(found):
        bare = re.sub(rf"[\d.]+ {unit}|x [\d.]+", "", line)
        assert len(re.findall(r"\d[\d.]*", bare)) == (1 if place < 5 else 0), line
    assert max(map(len, out.splitlines())) <= 100


def test_files_and_pictures(command_line, tmp_path):
    line = ("vpm", "--vehicle", "spark", "--board", "xavier", "--out", "report")
    code, out, _ = command_line(*line)
    assert code == 0
    files = "vpm.json, vpm.csv, roofline.svg, redundancy.svg"
    assert out.splitlines()[-1] == f"Files  report: {files}"
    folder = tmp_path / "report"
    first = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert set(first) == {"roofline.svg", "redundancy.svg", "vpm.json", "vpm.csv"}
    words = {
        name: " ".join(text.text or "" for text in ET.fromstring(data).iter(f"{SVG}text"))
        for name, data in first.items()
        if name.endswith(".svg")
    }
    assert "TMR cannot be lifted" in words["roofline.svg"]
    assert "action throughput, Hz" in words["roofline.svg"]
    assert "cannot be lifted" in words["redundancy.svg"]
    assert "rotor_pull_n = 8.331 N is calibrated" in words["redundancy.svg"]
    assert command_line(*line)[0] == 0
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == first


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--vehicle", "sparck"), "--vehicle: .*'sparck'.* 'spark'"),
        (("--vehicle", "spark", "--vehicle", "spark"), "--vehicle: .*spark twice"),
        (("--platform", "tx3"), "--platform: .*'tx3'.* 'tx2'"),
        (("--board", "xaviar"), "--board: .*'xaviar'.* 'xavier'"),
        (("--overhead", "aead=1"), ".*'aead'.* 'aad'"),
        (("--vehicle", "none.toml"), "none.toml: no such file"),
        (("--out", "file/below"), ".*'--out': file/below: this folder cannot be created"),
    ],
)
def test_bad_input_is_one_line(command_line, tmp_path, arguments, said):
    (tmp_path / "file").touch()
    code, out, err = command_line("vpm", *arguments)
    assert (code, out) == (1 if "no such file" in said else 2, "")
    (line,) = err.splitlines()
    assert re.match(f"error: {said}", line)


KERNELS = ("point_cloud", "octomap", "collision_check", "planner", "control")


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("[kernels.control]\nlatency_s = 0.1\n", "", "error: p.toml: kernels.control: missing"),
        ("[kernels.planner]\nlatency_s = 0.1", "[kernels.planner]\nlatency_s = -0.1",
         "error: p.toml:11: kernels.planner: latency_s .*at least 0, got -0.1"),
        ("power_w = 5.0", "power_w = -5.0", "error: p.toml: power_w: .*at least 0, got -5"),
        ("mass_kg = 0.1", "mass_kg = 9.0",
         r"error: .*'spark' .* 8\.33 N .* 0\.850 kg, .*0\.300 kg \+ 9\.000 kg .* 9\.300 kg"),
    ],
)  # fmt: skip
def test_a_bad_profile_is_one_line(command_line, tmp_path, old, new, said):
    kernels = "".join(f"[kernels.{kernel}]\nlatency_s = 0.1\n" for kernel in KERNELS)
    text = f'name = "p"\ncores = 1\npower_w = 5.0\nmass_kg = 0.1\n{kernels}'
    (tmp_path / "p.toml").write_text(text)
    assert command_line("vpm", "--vehicle", "spark", "--platform", "p.toml")[0] == 0
    assert old in text
    (tmp_path / "p.toml").write_text(text.replace(old, new))
    code, out, err = command_line("vpm", "--vehicle", "spark", "--platform", "p.toml")
    assert (code, out) == (1, "")
    (line,) = err.splitlines()
    assert re.match(said, line)


@pytest.mark.parametrize(
    "arguments",
    [("--overhead", "aad"), ("--overhead", "a" * 300), ("--range", "0"), ("--response=-1",),
     ("--json", "--csv"), ("--distance", "nan"), ("--range", "inf")],
)  # fmt: skip
def test_usage(command_line, arguments):
    code, out, err = command_line("vpm", *arguments)
    assert (code, out) == (2, "")
    assert err.startswith("error: ")
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((), "--chain needs --platform"),
        (("--platform", "tx2", "--response", "0.2"), "--chain cannot be combined with --response"),
    ],
)
def test_a_chain_of_no_latencies_is_refused(command_line, arguments, said):
    for chain in ("serial", "pipelined"):
        code, out, err = command_line("vpm", "--chain", chain, *arguments)
        assert (code, out) == (2, "")
        assert said in err


def test_a_chain_says_how_a_platform_s_latencies_add_up(command_line):
    line = ("vpm", "--vehicle", "airsim", "--platform", "tx2", "--chain", "pipelined", "--full")
    code, out, _ = command_line(*line)
    assert code == 0
    assert "platform tx2: slowest of point_cloud, octomap" in out


def test_platforms(command_line, tmp_path):
    code, out, _ = command_line("platforms")
    assert code == 0
    for name in ("x86", "tx2", "tx2-2c-0.81", "tx2-2c-2.04", "tx2-4c-0.81"):
        assert re.search(rf"^{re.escape(name)} +\d+ cores", out, re.M)
    code, out, _ = command_line("platforms", "x86", "tx2")
    assert re.search(r"octomap +289\.00 ms", out)
    assert re.search(r"octomap +1346\.74 ms .* x86 x 4\.66: same workload", out)
    told = json.loads(command_line("platforms", "tx2", "--json")[1])
    assert told[0]["kernels"]["collision_check"]["latency_s"] == 0.074
    (tmp_path / "mine.toml").write_text('name = "mine"\nbase = "tx2"\ncores = 6\nscale = 0.5\n')
    code, out, _ = command_line("platforms", "mine.toml")
    assert re.search(r"octomap +673\.37 ms", out)
    assert "measured:FACTOR" in command_line("platforms")[1]
    assert "2.5 times" in command_line("platforms", "measured:2.5")[1]
    assert re.match("error: .*'tx1'.* 'tx2'", command_line("platforms", "tx1")[2])
