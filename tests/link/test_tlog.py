"""The .tlog, read by pymavlink's own mavlogdump.py."""

from __future__ import annotations

import datetime
import json
import subprocess
import sys
from pathlib import Path

import pymavlink
import pytest

from mavfi_cli.core.errors import RecordError
from mavfi_cli.link.codec import Codec, Message, dialect
from mavfi_cli.link.tlog import EPOCH_UNIX_S, RecordedLink, tlog_messages, unix_time_of_stamp_0
from mavfi_cli.link.transport import memory_pair

MAVLOGDUMP = Path(pymavlink.__file__).parent / "tools" / "mavlogdump.py"


def _position(number: int) -> Message:
    return dialect.MAVLink_local_position_ned_message(20 * number, 1, 2, -3, 0, 0, 0)


def _target(number: int) -> Message:
    return dialect.MAVLink_set_position_target_local_ned_message(
        20 * number, 1, 1, 1, 2503, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0.5, 0
    )


def _write(path: Path, ticks: int) -> list[bytes]:
    """Record that many states and the setpoints in answer. Return the frames on the wire."""
    ours, theirs = memory_pair("memory")
    vehicle, frames = Codec(1, 1), []
    link = RecordedLink(ours, 1, 191)
    with link.recording(path):
        for number in range(ticks):
            frames.append(vehicle.encode(_position(number)))
            theirs.send(frames[-1])
            assert len(link.messages(link.receive(0.0), number * 0.02)) == 1
            link.send([_target(number)], number * 0.02)
            frames.append(theirs.receive(0.0))
    return frames


def _records(data: bytes) -> list[tuple[int, bytes]]:
    """Time in microseconds and frame of every record; fails on half a record."""
    records, at = [], 0
    while at < len(data):
        length = 12 + data[at + 9]
        frame = data[at + 8 : at + 8 + length]
        assert len(frame) == length
        records.append((int.from_bytes(data[at : at + 8], "big"), frame))
        at += 8 + length
    return records


@pytest.mark.parametrize("place", [8, 12 + 8 + 4])  # the marker, and a byte of the payload
def test_reading_ends_at_the_first_damaged_record(tmp_path: Path, place: int) -> None:
    path = tmp_path / "flight.tlog"
    _write(path, 3)
    records = _records(path.read_bytes())
    start = sum(8 + len(frame) for _, frame in records[:2])
    data = bytearray(path.read_bytes())
    data[start + place] ^= 0x55
    path.write_bytes(data)
    assert [m.get_type() for _, m in tlog_messages(path)] == [
        "LOCAL_POSITION_NED", "SET_POSITION_TARGET_LOCAL_NED",
    ]  # fmt: skip


def test_mavlogdump_reads_both_directions(tmp_path: Path) -> None:
    path = tmp_path / "flight.tlog"
    _write(path, 50)
    done = subprocess.run(
        [sys.executable, str(MAVLOGDUMP), "--format", "json", str(path)],
        capture_output=True,
        text=True,
        check=True,
    )
    dumped = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    kinds = [entry["meta"]["type"] for entry in dumped]
    assert kinds == ["LOCAL_POSITION_NED", "SET_POSITION_TARGET_LOCAL_NED"] * 50
    assert [entry["data"]["time_boot_ms"] for entry in dumped] == [
        20 * (k // 2) for k in range(100)
    ]
    stamps = [entry["meta"]["timestamp"] - EPOCH_UNIX_S for entry in dumped]
    assert stamps == pytest.approx([0.02 * (k // 2) for k in range(100)], abs=1e-5)


def test_the_epoch_is_a_fixed_day() -> None:
    day = datetime.datetime.fromtimestamp(EPOCH_UNIX_S, datetime.UTC)
    assert day == datetime.datetime(2020, 1, 1, tzinfo=datetime.UTC)


def test_the_same_flight_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("one", "two"):
        _write(tmp_path / name, 20)
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()


def test_every_frame_is_there_as_it_was_on_the_wire(tmp_path: Path) -> None:
    frames = _write(tmp_path / "log", 20)
    records = _records((tmp_path / "log").read_bytes())
    assert [frame for _, frame in records] == frames
    assert records[2][0] == EPOCH_UNIX_S * 1_000_000 + 20_000


RECORDING = """
import os, resource, signal
from pathlib import Path
from mavfi_cli.core.errors import RecordError
from mavfi_cli.link.codec import dialect
from mavfi_cli.link.tlog import RecordedLink
from mavfi_cli.link.transport import memory_pair
ends = memory_pair("memory")
link = RecordedLink(ends[0], 1, 1)
message = dialect.MAVLink_local_position_ned_message(1, 1, 2, 3, 4, 5, 6)
"""


def test_a_kill_leaves_whole_records_of_all_but_the_last_second(tmp_path: Path) -> None:
    path = tmp_path / "log"
    program = f"""{RECORDING}
with link.recording(Path({str(path)!r})):
    for k in range(1000):
        link.send([message], 0.02 * k)
    os.kill(os.getpid(), signal.SIGKILL)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == -9, done.stderr
    assert 949 <= len(_records(path.read_bytes())) <= 1000


def test_a_log_ends_with_a_whole_record_before_its_limit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mavfi_cli.link.tlog._LARGEST", 12_000)
    path = tmp_path / "log"
    frames = _write(path, 200)
    kept = [frame for _, frame in _records(path.read_bytes())]
    assert 6_000 < path.stat().st_size <= 12_000
    assert kept == frames[: len(kept)]


def test_a_full_disk_is_one_clear_line() -> None:
    with pytest.raises(RecordError, match=r"/dev/full: .*No space left"):
        _write(Path("/dev/full"), 1)


def test_a_disk_that_fills_up_keeps_whole_records(tmp_path: Path) -> None:
    path = tmp_path / "log"
    program = f"""{RECORDING}
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (10_001, 10_001))
try:
    with link.recording(Path({str(path)!r})):
        for k in range(1000):
            link.send([message], 0.1 * k)
except RecordError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert "cannot write: File too large" in done.stdout, done.stderr
    assert len(_records(path.read_bytes())) > 100


def test_a_place_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(RecordError, match="No such file or directory"):
        _write(tmp_path / "nowhere" / "log", 0)


def test_a_foreign_flight_tells_its_date_by_its_first_state(tmp_path: Path) -> None:
    path, now_s = tmp_path / "flight.tlog", [1_790_000_000.0]
    ours, theirs = memory_pair("memory")
    link = RecordedLink(ours, 1, 191, clock=lambda: now_s[0])
    with link.recording(path):
        link.send([dialect.MAVLink_ping_message(0, 0, 0, 0)], 0.0)
        now_s[0] += 7.5
        theirs.send(Codec(1, 1).encode(_position(2)))  # its stamp is 0.04 s
        link.messages(link.receive(0.0), 0.0)
    assert unix_time_of_stamp_0(path) == pytest.approx(1_790_000_007.46)
    path.write_bytes(b"")
    assert unix_time_of_stamp_0(path) == EPOCH_UNIX_S
    with pytest.raises(RecordError, match="none: "):
        unix_time_of_stamp_0(tmp_path / "none")
