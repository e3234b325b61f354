"""`mavfi view` and `mavfi fly --record`."""

import json
import re
import shutil
from importlib import util
from pathlib import Path

import pytest
from missions import RECORD, SHORT_LINE

from mavfi_cli.report import view

rerun = pytest.importorskip("rerun")
reader = pytest.importorskip("mcap.reader")


def topics(path):
    with Path(path).open("rb") as stream:
        summary = reader.make_reader(stream).get_summary()
    return {channel.topic for channel in summary.channels.values()}


@pytest.fixture(scope="module")
def struck(mavfi, tmp_path_factory):
    """Run folder of a flight with a fault, and its file for Foxglove."""
    out = tmp_path_factory.mktemp("struck")
    line = (*SHORT_LINE, "--inject", "waypoint_yaw", "--quiet", "--no-picture", "--out", out)
    done = mavfi(*line, "--record", "mcap")
    assert done.returncode == 0, done.stderr
    (run,) = out.iterdir()
    return run


@pytest.mark.slow
def test_fly_keeps_the_whole_flight(struck, mavfi, tmp_path):
    """And changes nothing else of its record."""
    told = {topic.partition("/")[2].partition("/")[0] for topic in topics(struck / "flight.mcap")}
    assert told == {"world", "flight"}
    assert {f"/flight/{name}" for name in ("camera/depth", "cloud", "map", "faults")} <= topics(
        struck / "flight.mcap"
    )
    assert {p.name for p in struck.iterdir()} - {"golden"} == {*RECORD, "fault.json", "flight.mcap"}
    again = mavfi("replay", struck, "--out", tmp_path)
    assert again.stdout.startswith("identical")


@pytest.mark.slow
def test_a_fault_is_seen_beside_its_golden_flight(struck, mavfi, tmp_path):
    before = json.loads((struck / "result.json").read_text())
    done = mavfi("view", struck, "--save", tmp_path / "pair.rrd")
    assert (done.returncode, done.stdout) == (0, f"{tmp_path / 'pair.rrd'}\n"), done.stderr
    done = mavfi("view", struck, "--save", tmp_path / "pair.mcap", "--json")
    told = json.loads(done.stdout)
    assert told["file"] == str(tmp_path / "pair.mcap")
    assert [(each["name"], each["frames"]) for each in told["flights"]] == [
        ("golden", True), ("faulty", True),
    ]  # fmt: skip
    told = topics(tmp_path / "pair.mcap")
    for flight in ("golden", "faulty"):
        assert {f"/{flight}/{each}" for each in ("camera/depth", "map", "states")} <= told
    assert (tmp_path / "pair.rrd").read_bytes()[:4] == b"RRF2"
    assert json.loads((struck / "result.json").read_text()) == before
    assert (struck / "golden" / "result.json").is_file()


def test_a_flight_that_does_not_repeat_is_shown_without_what_its_nodes_received(
    short_flight, mavfi, tmp_path
):
    run = tmp_path / "foreign"
    shutil.copytree(short_flight.path, run)
    result = json.loads((run / "result.json").read_text())
    result["config"] |= {"link": "udpin:127.0.0.1:14540", "eyes": True}
    (run / "result.json").write_text(json.dumps(result))
    done = mavfi("view", run, "--save", tmp_path / "foreign.mcap")
    assert done.returncode == 0
    assert "`mavfi fly --record`" in done.stderr
    told = topics(tmp_path / "foreign.mcap")
    assert "/flight/states" in told
    assert "/flight/map" not in told


def test_a_repetition_that_differs_is_told(short_flight, mavfi, tmp_path):
    run = tmp_path / "other"
    shutil.copytree(short_flight.path, run)
    with (run / "trace.parquet").open("r+b") as trace:  # one bit, of what no reader looks at
        data = bytearray(trace.read())
        at = data.rindex(b"parquet-cpp")
        data[at] ^= 1
        trace.seek(0)
        trace.write(data)
    done = mavfi("view", run, "--save", tmp_path / "other.mcap")
    assert done.returncode == 0, done.stderr
    assert "warning: " in done.stderr
    assert "the repetition differs" in done.stderr


@pytest.mark.parametrize(
    ("missing", "line", "told"),
    [
        ("rerun", [], "pip install 'mavfi[view]'"),
        ("rerun", ["--save", "x.rrd"], "pip install 'mavfi[view]'"),
        ("mcap_protobuf", ["--save", "x.mcap"], "pip install 'mavfi[mcap]'"),
    ],
)
def test_a_missing_extra_is_named_before_anything_flies(
    missing, line, told, short_flight, mavfi, monkeypatch
):
    monkeypatch.setattr(view, "find_spec", lambda n: None if n == missing else util.find_spec(n))
    done = mavfi("view", short_flight.path, *line)
    assert (done.returncode, done.stdout, len(done.stderr.splitlines())) == (1, "", 1)
    assert told in done.stderr


def test_without_a_display_a_file_is_offered_before_anything_flies(
    short_flight, mavfi, monkeypatch
):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    done = mavfi("view", short_flight.path)
    assert (done.returncode, done.stdout, len(done.stderr.splitlines())) == (1, "", 1)
    assert re.match("error: .*no display.*--save FILE.rrd", done.stderr)


def test_bad_input_is_one_line(short_flight, mavfi, tmp_path):
    for line, code, told in (
        ([short_flight.path, "--save", "x.png"], 2, ".rrd or .mcap"),
        ([tmp_path / "nothing", "--save", "x.mcap"], 1, "no such run folder"),
        ([short_flight.path, "--save", tmp_path / "no" / "x.mcap"], 2, "its folder does not exist"),
    ):
        done = mavfi("view", *line)
        assert done.returncode == code
        assert told in done.stderr
        assert done.stderr.startswith("error: ")  # before anything is flown
