"""Faults in the messages and processes of a user's companion."""

import errno
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from live_processes import LONG_S
from pymavlink.dialects.v10 import common as v10
from pymavlink.dialects.v20 import ardupilotmega

from mavfi_cli import library
from mavfi_cli.cli.fly import _TOO_SHORT
from mavfi_cli.core.errors import FaultSpecError, MavfiError, TracingForbidden, UnknownName
from mavfi_cli.fi.injector import Moment
from mavfi_cli.fi.tracer import linux
from mavfi_cli.link import codec, fields
from mavfi_cli.link.codec import Codec, Signing, dialect, frame_of, key_from_passphrase
from mavfi_cli.link.fields import WireFields
from mavfi_cli.link.router import Side
from mavfi_cli.mission.companion_faults import (
    CompanionInjection,
    LinkInjector,
    check_companion_fault,
)
from mavfi_cli.mission.programs import Programs, Throttle
from mavfi_cli.report.summary import summary_lines
from mavfi_cli.spec.companion import CompanionConfig, ProgramConfig
from mavfi_cli.spec.fault import FaultConfig, InstructionConfig

HOP = Path(__file__).with_name("hop.py")
SETPOINT = "SET_POSITION_TARGET_LOCAL_NED"
CLOCK = 1_700_000_000.0
KEY = key_from_passphrase("secret")


def setpoint(number=0, codec=None, vx=2.0):
    """A received setpoint, as the router decodes it."""
    message = dialect.MAVLink_set_position_target_local_ned_message(
        number, 1, 1, 1, 0b1001_1100_0111, 0, 0, 0, vx, 0, 0, 0, 0, 0, 0.5, 0
    )
    frame = (codec or Codec(1, 191)).encode(message)
    return Codec(0, 0, keeps_unknown=True).decode(frame)[0]


def injector(target, *, signing=None, **request):
    return LinkInjector(
        FaultConfig(target=target, at="time=0", **request),
        shortest_flight_s=1.0, listener=lambda strike: None, signing=signing,
    )  # fmt: skip


def hop_file(folder, speed):
    """A companion's file whose program hops at a multiple of real time."""
    path = folder / "hop.toml"
    path.write_text(
        f"[program.hop]\ncommand = '{sys.executable} -u {HOP} {{link}} {speed} lands'\n"
        "[success]\nlanded = true\n"
    )
    return path


def at(stamp_s):
    return Moment(stamp_s=stamp_s, flight_s=stamp_s, tick=0, phase="OFFBOARD")


def passed(link, messages, side=Side.COMPANION):
    return [m for n, own in enumerate(messages) for m in link.pass_between(own, side, at(n * 0.1))]


def test_a_struck_frame_is_valid_and_differs_in_the_field_only():
    before = setpoint()
    (after,) = passed(injector(f"{SETPOINT}.vx", exact_bits=(30,)), [before])
    (read,) = Codec(0, 0).decode(frame_of(after))
    assert (before.vx, read.vx) == (2.0, 0.0)
    assert read.get_header().pack() == before.get_header().pack()
    assert {**read.to_dict(), "vx": 2.0} == before.to_dict()


@pytest.mark.parametrize(("index", "bit", "text"), [(0, 1, b"OPE"), (3, 0, b"MPE\1")])
def test_a_character_of_a_text_is_struck(index, bit, text):
    message = dialect.MAVLink_param_request_read_message(1, 1, b"MPE", -1)
    (before,) = Codec(0, 0).decode(Codec(1, 191).encode(message))
    link = injector(f"PARAM_REQUEST_READ.param_id[{index}]", exact_bits=(bit,))
    (after,) = passed(link, [before])
    (read,) = Codec(0, 0).decode(frame_of(after))
    assert (read._param_id_raw, read.param_index) == (text, -1)


def test_a_message_that_only_ardupilot_has_is_struck(monkeypatch):
    monkeypatch.setattr(fields, "ADDED", codec.ADDED.copy())
    monkeypatch.setattr(codec, "ADDED", fields.ADDED)
    monkeypatch.setattr(codec, "_KINDS", codec._KINDS.copy())
    sender = ardupilotmega.MAVLink(None, srcSystem=1, srcComponent=1)
    frame = ardupilotmega.MAVLink_rangefinder_message(2.0, 0.5).pack(sender)
    link = injector("RANGEFINDER.distance", exact_bits=(30,))
    (before,) = Codec(0, 0, keeps_unknown=True).decode(frame)
    (after,) = passed(link, [before], Side.AUTOPILOT)
    (read,) = ardupilotmega.MAVLink(None).parse_buffer(frame_of(after))
    assert (read.distance, read.voltage, read.get_srcSystem()) == (0.0, 0.5, 1)


def test_every_byte_of_every_message_has_a_state():
    for kind in dialect.mavlink_map.values():
        states = WireFields.of(kind.msgname).states.values()
        sizes = [np.dtype(state.dtype.value).itemsize for state in states]
        assert sum(sizes) == kind.unpacker.size, kind.msgname


def test_a_signed_frame_is_signed_again_and_stays_out_without_a_key():
    def signing():
        return Signing(KEY, lambda: CLOCK)

    before = setpoint(codec=Codec(1, 191, signing=signing()))
    target = f"{SETPOINT}.vx"
    (after,) = passed(injector(target, exact_bits=(30,), signing=signing()), [before])
    (read,) = Codec(0, 0, signing=signing()).decode(frame_of(after))
    assert read.vx == 0.0
    locked = injector(target, exact_bits=(30,))
    assert passed(locked, [before]) == [before]
    assert "key_file" in locked.missed


@pytest.mark.parametrize(
    ("effect", "numbers"),
    [("twice", [0, 0, 1, 2, 3]), ("swap", [1, 0, 2, 3]), ("late=0.15", [1, 2, 3, 0])],
)
def test_a_signed_frame_arrives_twice_late_or_out_of_order(effect, numbers):
    def signing():
        return Signing(KEY, lambda: CLOCK)

    codec = Codec(1, 191, signing=signing())
    sent = [setpoint(number, codec) for number in range(4)]
    link = injector(SETPOINT, effect=effect, signing=signing())
    frames = [frame_of(m) for m in passed(link, sent)]
    frames += [frame_of(m) for m, _ in link.release(1.0)]
    receiver = Codec(0, 0, signing=signing())
    assert [m.time_boot_ms for m in receiver.decode(b"".join(frames))] == numbers
    locked = injector(SETPOINT, effect=effect)
    assert passed(locked, sent) == sent
    assert "key_file" in locked.missed


def test_an_old_frame_keeps_its_length():
    old = dialect.MAVLink(None, srcSystem=1, srcComponent=191)
    frame = dialect.MAVLink_set_position_target_local_ned_message(
        0, 1, 1, 1, 0, 0, 0, 0, 2.0, 0, 0, 0, 0, 0, 0, 0
    ).pack(old, force_mavlink1=True)
    (before,) = Codec(0, 0).decode(frame)
    (after,) = passed(injector(f"{SETPOINT}.vx", exact_bits=(30,)), [before])
    assert len(frame_of(after)) == len(frame)
    assert Codec(0, 0).decode(frame_of(after))[0].vx == 0.0


def test_a_field_that_an_old_frame_does_not_carry_is_not_struck():
    def link():
        return injector("COMMAND_ACK.progress", exact_bits=(0,))

    old = v10.MAVLink_command_ack_message(400, 0).pack(v10.MAVLink(None))
    (before,) = Codec(0, 0).decode(old)
    struck = link()
    (after,) = passed(struck, [before], Side.AUTOPILOT)
    assert after is before
    assert "MAVLink 1" in struck.missed
    (before,) = Codec(0, 0).decode(
        dialect.MAVLink_command_ack_message(400, 0, 7).pack(dialect.MAVLink(None))
    )
    (after,) = passed(link(), [before], Side.AUTOPILOT)
    assert after.progress == 6


@pytest.mark.parametrize(
    ("effect", "numbers"),
    [("drop", [1, 2, 3]), ("twice", [0, 0, 1, 2, 3]), ("swap", [1, 0, 2, 3]),
     ("late=0.15", [1, 2, 3])],
)  # fmt: skip
def test_a_message_is_dropped_repeated_swapped_or_late(effect, numbers):
    link = injector(SETPOINT, effect=effect)
    assert [m.time_boot_ms for m in passed(link, map(setpoint, range(4)))] == numbers
    assert [m.time_boot_ms for m, side in link.release(0.1)] == []
    late = [(m.time_boot_ms, side) for m, side in link.release(0.2)]
    assert late == ([(0, Side.COMPANION)] if "late" in effect else [])


def test_messages_are_dropped_for_a_time_and_fields_set_to_zero():
    link = injector(SETPOINT, effect="drop", persistence="stuck-at", duration_s=0.25)
    assert [m.time_boot_ms for m in passed(link, map(setpoint, range(5)))] == [3, 4]
    zero = injector(f"{SETPOINT}.vx", effect="zero")
    assert [m.vx for m in passed(zero, map(setpoint, range(2)))] == [0.0, 2.0]


def test_a_swapped_message_follows_the_next_of_its_own_side():
    link = injector("HEARTBEAT", effect="swap")
    ours, theirs = (
        Codec(0, 0).decode(
            Codec(1, part).encode(dialect.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3))
        )
        for part in (191, 1)
    )
    assert passed(link, ours) == []
    assert passed(link, theirs, Side.AUTOPILOT) == theirs
    assert len(passed(link, ours)) == 2


def test_the_hint_knows_the_reason_of_a_random_time_after_the_flight(tmp_path):
    fault = CompanionInjection(FaultConfig(target="process.hop"))
    fault.aim_at(1.0)
    fault.begin(tmp_path / "fault.json")
    fault.tick(at(0.0))
    assert fault.injector.missed.startswith(_TOO_SHORT)


def test_a_phase_without_the_message_is_not_missed(tmp_path):
    fault = CompanionInjection(FaultConfig(target=SETPOINT, effect="drop", at="phase=AUTO.TAKEOFF"))
    fault.aim_at(1.0)
    fault.begin(tmp_path / "fault.json")
    fault.tick(at(0.0)._replace(phase="AUTO.TAKEOFF"))
    assert f"no {SETPOINT} came after phase" in fault.injector.missed
    assert passed(fault.link, [setpoint()]) == []


def test_a_program_that_does_not_run_is_not_struck(tmp_path):
    fault = CompanionInjection(FaultConfig(target="process.hop", at="time=0"))
    fault.aim_at(1.0)
    fault.begin(tmp_path / "fault.json")
    fault.tick(at(0.0))
    written = fault.finish()
    assert (written["state"], written["reason"]) == ("not_injected", "the program was not running")


def test_a_frozen_field_stays_and_an_ignored_one_is_not_read():
    link = injector(f"{SETPOINT}.vx", effect="freeze", persistence="stuck-at", duration_s=0.25)
    values = [m.vx for m in passed(link, [setpoint(vx=vx) for vx in (1.0, 2.0, 3.0, 4.0)])]
    assert values == [1.0, 1.0, 1.0, 4.0]
    ignored = injector(f"{SETPOINT}.x")
    (struck,) = passed(ignored, [setpoint()])
    ignored.deliver(struck, Side.COMPANION, 0.0)
    assert ignored.follower.activation.value == "not_read"
    rates = dialect.MAVLink_set_attitude_target_message(
        0, 1, 1, 128, [1.0, 0.0, 0.0, 0.0], 0.3, 0.0, 0.0, 0.5
    )
    (rates,) = Codec(0, 0).decode(Codec(1, 191).encode(rates))
    for field, activation in (("q[0]", "not_read"), ("body_roll_rate", "read")):
        link = injector(f"SET_ATTITUDE_TARGET.{field}")
        (struck,) = passed(link, [rates])
        link.deliver(struck, Side.COMPANION, 0.0)
        assert link.follower.activation.value == activation


def test_direction_and_components():
    link = injector(f"output.{SETPOINT}.vx", together=True, effect="random")
    assert passed(link, [setpoint()], Side.AUTOPILOT)[0].vx == 2.0
    passed(link, [setpoint()])
    (strike,) = link.strikes
    assert [c.state[-2:] for c in strike.changes] == ["vx", "vy", "vz"]


@pytest.mark.parametrize(
    ("target", "settings", "error", "problem"),
    [
        (f"{SETPOINT}.vxx", {}, UnknownName, f"did you mean '{SETPOINT}.vx'"),
        ("LOCAL_POSITON_NED.z", {}, UnknownName, "did you mean 'LOCAL_POSITION_NED'"),
        ("planning", {}, FaultSpecError, "MAVLink message"),
        ("process.hopp", {}, UnknownName, "did you mean 'hop'"),
        (f"{SETPOINT}.vx", {"effect": "drop"}, FaultSpecError, "whole message"),
        (f"{SETPOINT}.vx", {"exact_bits": (32,)}, FaultSpecError, "between 0 and 31"),
        (SETPOINT, {"effect": "late=0"}, FaultSpecError, "above 0"),
        (SETPOINT, {"effect": "late"}, FaultSpecError, "needs a number, as in late=0.5"),
        (SETPOINT, {"effect": "late=x"}, FaultSpecError, "a number"),
        (SETPOINT, {"effect": "stop"}, FaultSpecError, "got stop"),
        (SETPOINT, {"at": "foreseen"}, FaultSpecError, "foreseen"),
        ("process.hop", {"effect": "zero"}, FaultSpecError, "got zero"),
        ("process.hop", {"effect": "slow=2"}, FaultSpecError, "at most 1"),
        ("process.hop//bin/true", {}, FaultSpecError, "without its folder"),
        ("process.hop/sleep", {"effect": "stop"}, FaultSpecError, "leave out /sleep"),
        ("process.hopp/sleep", {}, UnknownName, "did you mean 'hop'"),
        ("process.hop", {"duration_s": 2.0}, FaultSpecError, "stop and slow a duration"),
        ("process.hop", {"exact_bits": (3,)}, FaultSpecError, "stop and slow a duration"),
        ("process.hop", {"persistence": "stuck-at"}, FaultSpecError, "stop and slow a duration"),
        (SETPOINT, {"effect": "drop", "together": True}, FaultSpecError, "takes no bits"),
        (SETPOINT, {"at": "phase=OFBOARD"}, UnknownName, "did you mean 'OFFBOARD'"),
        ("process.hop", {"at": "phase=offboard"}, UnknownName, "did you mean 'OFFBOARD'"),
        ("process.hop", {"at": "phase=OFBOARD"}, UnknownName, "did you mean 'OFFBOARD'"),
        ("process.hop", {"at": "phase="}, UnknownName, "flight mode"),
        ("process.hop", {"at": "time=21"}, FaultSpecError, "time limit of 20 s"),
    ],
)
def test_faults_that_a_companion_cannot_have(target, settings, error, problem):
    hop = CompanionConfig(program={"hop": ProgramConfig(command="true")}, time_limit_s=20.0)
    with pytest.raises(error, match=problem.replace(".", "\\.")):
        check_companion_fault(FaultConfig(target=target, **settings), hop)


def test_a_process_that_a_program_has_started_is_killed_and_the_program_goes_on(tmp_path):
    task = {
        "argv": ["sh", "-c", "sleep 600; echo over; sleep 600"], "folder": str(tmp_path),
        "environment": {}, "restart": "never", "restart_s": 0.0, "ready_line": "over",
    }  # fmt: skip
    programs = Programs(tmp_path)
    try:
        program = programs.start("shell", task)
        until_s = time.monotonic() + LONG_S
        while program.process("sleep") is None:
            assert time.monotonic() < until_s

        def struck(executable):
            target = f"process.shell/{executable}"
            fault = CompanionInjection(FaultConfig(target=target, at="time=0"))
            fault.running = {"shell": program}
            fault.aim_at(1.0)
            fault.begin(tmp_path / "fault.json")
            fault.tick(at(0.0))
            return fault.finish()

        assert struck("sleep")["state"] == "applied"
        while not program.ready:
            assert program.poll()
            assert time.monotonic() < until_s
        assert program.pid is not None
        assert struck("absent")["reason"] == "the program was not running"
    finally:
        programs.close()


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_a_stopped_program_does_not_run_and_goes_on(tmp_path, share):
    code = "import os\nwhile True: os.times()"
    task = {
        "argv": [sys.executable, "-c", code], "folder": str(tmp_path), "environment": {},
        "restart": "never", "restart_s": 0.0, "ready_line": None,
    }  # fmt: skip
    programs = Programs(tmp_path)
    try:
        program = programs.start("busy", task)
        until_s = time.monotonic() + LONG_S
        while program.pid is None and time.monotonic() < until_s:
            program.poll()
        stat = Path(f"/proc/{program.pid}/stat")

        def states(number=100):
            return {stat.read_text().split()[2] for _ in range(number) if not time.sleep(0.002)}

        if share < 1.0:
            program.throttle = Throttle(program, share)
        fault = CompanionInjection(
            FaultConfig(target="process.busy", at="time=0", effect="stop", duration_s=5.0)
        )
        fault.running = {"busy": program}
        fault.aim_at(1.0)
        fault.begin(tmp_path / "fault.json")
        fault.tick(at(0.0))
        while states() != {"T"}:
            assert time.monotonic() < until_s
        fault.tick(at(6.0))
        while "R" not in states():
            assert time.monotonic() < until_s
        if share < 1.0:
            program.throttle.end()
        assert "T" not in states()
        os.kill(program.pid, signal.SIGTERM)
    finally:
        programs.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "outcome", "line"),
    [
        ({"target": f"{SETPOINT}.vx", "exact_bits": (30,)}, "success", "2 -> 0"),
        ({"target": "process.hop"}, "crash", "process.hop is killed"),
        (
            {"target": "process.hop", "effect": "stop", "duration_s": 2.0},
            "success",
            "is stopped for 2 s",
        ),
        (
            {"target": "process.hop", "effect": "slow=0.5", "duration_s": 2.0},
            "success",
            "process.hop is slowed to 0.5 of a processor",
        ),
        ({"target": SETPOINT, "effect": "late=0.2"}, "success", "transient late=0.2"),
    ],
)
def test_a_struck_flight_has_a_record_of_its_fault(tmp_path, fault, outcome, line):
    companion = hop_file(tmp_path, 2)
    run = library.fly(
        companion=str(companion), world="farm", speed=2.0, time_limit_s=60.0, out=tmp_path,
        fault=FaultConfig(**fault, at="time=7"),
    )  # fmt: skip
    assert run.record.outcome == outcome
    assert run.record.state_fault.state == "applied"
    assert any(line in text for text in summary_lines(run.record))
    assert any(event.kind == "fault" for event in run.record.events)


@pytest.mark.slow
@pytest.mark.parametrize("process", ["hop", "hop/hop.py"])
def test_an_instruction_of_a_program_is_struck_in_flight_and_struck_again(tmp_path, mavfi, process):
    companion = hop_file(tmp_path, 2)
    line = ["fly", "--companion", companion, "--world", "farm", "--speed", 2, "--time-limit", 60]
    line += ["--no-picture", "--quiet", "--json", "--out", tmp_path]
    drawn = ["--level", "instruction", "--inject", process, "--at", "time=4"]
    faults = []
    for fault in ([*drawn, "--fault-seed", 5], ["--replay", tmp_path / "farm-3-001"]):
        done = mavfi(*line, *fault)
        result = json.loads(done.stdout)
        faults.append(result["fault"])
        assert result["outcome"] in ("success", "crash", "failsafe", "timeout")
        assert result["config"]["instruction"]["at"] == "time=4"
        assert any(event["kind"] == "fault" for event in result["events"])
    assert all(fault["state"] == "applied" and fault["node"] == "hop" for fault in faults)
    assert faults[0]["symbol"] == faults[1]["symbol"]
    first, again = ((fault["object"], fault["offset"], fault["corruption"]) for fault in faults)
    assert first == again
    assert not first[0].startswith(("python", "libpython"))


@pytest.mark.slow
def test_a_static_program_is_struck_in_flight(tmp_path, native_program):
    try:
        counting = native_program("counting", "-static")
    except subprocess.CalledProcessError:
        pytest.skip("no static libc")
    companion = hop_file(tmp_path, 4)
    more = f"[program.counting]\ncommand = '{counting} 1000000000000'\n"
    companion.write_text(more + companion.read_text())
    run = library.fly(
        companion=str(companion), world="farm", speed=4.0, time_limit_s=60.0, out=tmp_path,
        instruction=InstructionConfig(target="counting", at="time=4", seed=1),
    )  # fmt: skip
    fault = run.record.instruction_fault
    assert (fault.state, fault.node, fault.object) == ("applied", "counting", counting.name)
    assert fault.symbol.split("+")[0] in ("main", "body")


def test_without_permission_to_trace_nothing_flies_and_the_remedy_is_told(tmp_path, monkeypatch):
    def refused(*_arguments):
        raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))

    monkeypatch.setattr(linux, "request", refused)
    companion = hop_file(tmp_path, 4)
    with pytest.raises(TracingForbidden, match=r"Operation not permitted(.|\n)*ptrace"):
        library.fly(
            companion=str(companion), world="farm", speed=4.0, out=tmp_path / "runs",
            instruction=InstructionConfig(target="hop", at="time=4"),
        )  # fmt: skip
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        (["--level", "instruction", "--inject", "hopp"], "did you mean 'hop'"),
        (["--level", "instruction", "--inject", "hop", "--at", "foreseen"], "got foreseen"),
        (["--level", "instruction", "--inject", "hop//bin/true"], "without its folder"),
        (["--level", "instruction", "--inject", "hop/"], "without its folder"),
        (["--golden", "2", "--expect", "success"], "--expect has no effect with --golden"),
        (["--golden", "2", "--inject", "process.hop"], "--inject has no effect with --golden"),
        (["--link", "udpin:127.0.0.1:0"], "--link: cannot be combined with --companion"),
        (["--link", "udpin:127.0.0.1:0", "--world", "farm"], "--link: cannot be combined with"),
        (["--inject", "ATTITUDE", "--effect", "late"], "late: needs a number, as in late=0.5"),
        (["--inject", "process.hop", "--effect", "slow"], "slow: needs a number, as in slow=0.5"),
        (["--detector", "gad", "--watch", "extended"], "no effect on the gate"),
        (["--detector", "gad", "--protect", "perception"], "must name planning"),
        (["--level", "instruction", "--inject", "hop", "--at", "time=400"], "time limit of 300 s"),
        (["--inject", "process.hop", "--scope", "libc.so.6"], "--level instruction"),
        (["--replay", ".", "--inject", "hop"], "--replay"),
    ],
)
def test_faults_in_instructions_that_a_companion_cannot_have(tmp_path, mavfi, line, problem):
    (tmp_path / "hop.toml").write_text("[program.hop]\ncommand = 'true'\n")
    done = mavfi("fly", "--companion", "hop.toml", *line, cwd=tmp_path)
    assert done.returncode == 2
    assert problem in done.stderr


@pytest.mark.parametrize("option", [["--scope", "x"], ["--function", "x"], ["--at", "time=3"]])
def test_settings_of_a_program_need_a_users_companion(tmp_path, mavfi, option):
    done = mavfi("fly", "--level", "instruction", "--inject", "octomap", *option, cwd=tmp_path)
    assert done.returncode == 2
    assert f"{option[0]} needs" in done.stderr
    done = mavfi("fly", "--replay", ".", cwd=tmp_path)
    assert "--replay needs --companion" in done.stderr


def test_a_message_needs_a_users_companion(tmp_path):
    with pytest.raises(MavfiError, match="needs --companion"):
        library.fly(fault=FaultConfig(target="LOCAL_POSITION_NED.z"), out=tmp_path)
