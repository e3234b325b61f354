"""The processes of real firmware, and what is no firmware."""

from __future__ import annotations

import contextlib
import os
import socket
import stat
import sys
from pathlib import Path

import pytest
from live_processes import LONG_S, gone

from mavfi_cli.core.errors import LinkError, VehicleProcessError
from mavfi_cli.core.files import ScratchFolder
from sitl.firmware import autopilot, px4
from sitl.firmware.autopilot import FirmwareProcess
from sitl.firmware.px4 import Px4Link
from sitl.firmware.sensors import Sensors
from sitl.firmware.simulation import FirmwareSimulation
from sitl.vehicle.profile import load_profile
from sitl.world import load_world


def _open(kind: str, binary: Path | None) -> FirmwareSimulation:
    world, profile = load_world("dense", seed=3), load_profile("solo")
    return FirmwareSimulation(
        world, profile, kind, binary, seed=1, system_id=7, url="udpin:127.0.0.1:0"
    )


def _program(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


def test_a_path_without_a_file(tmp_path: Path) -> None:
    with pytest.raises(VehicleProcessError, match="is not a file"):
        _open("px4", tmp_path / "px4")


def test_a_file_that_must_not_be_executed(tmp_path: Path) -> None:
    path = tmp_path / "px4"
    path.write_text("")
    with pytest.raises(VehicleProcessError, match="is not executable"):
        _open("px4", path)


def test_a_program_without_startup_files_is_no_px4(tmp_path: Path) -> None:
    program = _program(tmp_path / "bin" / "px4", "#!/bin/sh\n")
    with pytest.raises(VehicleProcessError, match="not PX4"):
        _open("px4", program)


def test_a_file_that_is_no_program(tmp_path: Path) -> None:
    program = _program(tmp_path / "arducopter", "no program")
    with pytest.raises(VehicleProcessError, match=r"cannot run the firmware .*: Exec"):
        _open("ardupilot", program)


@pytest.mark.parametrize(
    ("script", "told"),
    [
        ("echo no such model\nexit 3", "code 3: no such model"),
        ('echo "$@"\nexit 3', "--sysid 7 "),
    ],
    ids=["its words are told", "ardupilot gets its system id"],
)
def test_a_program_that_ends_is_no_firmware(tmp_path: Path, script: str, told: str) -> None:
    firmware = _open("ardupilot", _program(tmp_path / "arducopter", f"#!/bin/sh\n{script}\n"))
    try:
        with pytest.raises(VehicleProcessError, match=told):
            firmware.begin()
    finally:
        firmware.close()


_DYING_PX4 = f"""#!{sys.executable}
import socket, sys, time
port = 4560 + int(sys.argv[sys.argv.index("-i") + 1])
socket.create_connection(("127.0.0.1", port)).close()
print("INFO  [init] found model")
print("\\x1b[31mERROR [commander] \\x1b[0mno parameters", flush=True)
time.sleep(0.1)
sys.exit(3)
"""


def test_the_last_words_of_px4_are_in_the_error(tmp_path: Path) -> None:
    (tmp_path / "etc" / "init.d-posix").mkdir(parents=True)
    (tmp_path / "etc" / "init.d-posix" / "rcS").touch()
    firmware = _open("px4", _program(tmp_path / "bin" / "px4", _DYING_PX4))
    told = r"code 3: INFO  \[init\] found model \| ERROR \[commander\] no parameters$"
    try:
        with pytest.raises(VehicleProcessError, match=told):
            firmware.begin()
    finally:
        firmware.close()


def test_a_flood_of_output_takes_no_disk_and_keeps_the_last_words(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(autopilot, "_DEATH_S", LONG_S)
    scratch = ScratchFolder("test")
    script = "print('junk ' * 400_000, flush=True); print('no sensors'); raise SystemExit(3)"
    process = FirmwareProcess(Path(sys.executable), ["-c", script], scratch, {})
    assert str(process.explain("it closed its link")).endswith("no sensors")
    assert [path.name for path in scratch.path.iterdir()] == [".mavfi-scratch"]
    process.end()


def test_the_end_takes_children_and_folder_along() -> None:
    scratch = ScratchFolder("test")
    folder = scratch.path
    output = folder / "pids.txt"
    output.touch()
    script = (
        "import os, time; os.fork();"
        " print(os.getpid(), file=open('pids.txt', 'a'), flush=True); time.sleep(600)"
    )
    process = FirmwareProcess(Path(sys.executable), ["-c", script], scratch, {})
    while len(output.read_text().split()) < 2:
        process.require_running()
    pids = [int(word) for word in output.read_text().split()]
    process.end()
    process.end()
    assert not folder.exists()
    assert all(gone(pid) for pid in pids)


@pytest.mark.parametrize(
    ("kind", "family", "port"),
    [
        ("px4", socket.SOCK_STREAM, 4560),
        ("ardupilot", socket.SOCK_DGRAM, 9002),
    ],
    ids=["px4", "ardupilot"],
)
def test_a_port_in_use_is_told(kind: str, family: int, port: int) -> None:
    with socket.socket(socket.AF_INET, family) as holder:
        with contextlib.suppress(OSError):  # somebody else's, and so in use
            holder.bind(("127.0.0.1", port))
        if family == socket.SOCK_STREAM:
            holder.listen()
        with pytest.raises(LinkError, match="in use"):
            _open(kind, None)


@pytest.fixture
def instances_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(px4, "_SOCKET", str(tmp_path / "px4-{}"))
    monkeypatch.setattr(px4, "_CLAIM", str(tmp_path / "claim-{}"))
    monkeypatch.setattr(px4, "PORT", 45_600)


@pytest.mark.usefixtures("instances_of_its_own")
def test_a_number_that_another_px4_has_is_left_to_it(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as other:
        other.bind(str(tmp_path / "px4-0"))
        other.listen()
        link = Px4Link.open(Sensors(1), ours=True)
        link.close()
    assert link.port > 45_600
    link = Px4Link.open(Sensors(1), ours=True)
    link.close()
    assert link.port == 45_600


@pytest.mark.usefixtures("instances_of_its_own")
def test_flights_in_networks_of_their_own_have_different_instances(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "claim-0")
    (tmp_path / "claim-1").symlink_to(tmp_path / "elsewhere")
    first = Px4Link.open(Sensors(1), ours=True)
    first._transport.close()  # the port is free in another network
    second = Px4Link.open(Sensors(1), ours=True)
    first.close()
    third = Px4Link.open(Sensors(1), ours=True)
    assert not (tmp_path / "elsewhere").exists()
    assert second.port > first.port
    assert third.port == first.port
    second.close()
    third.close()
