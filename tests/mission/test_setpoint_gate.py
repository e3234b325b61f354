"""The gate before a user's companion: what it reads, withholds and passes on."""

import contextlib
import math
import os
import signal
import socket
import subprocess
import sys
import time
from importlib.metadata import EntryPoint, EntryPoints

import numpy as np
import pytest
from click.testing import CliRunner
from live_processes import LONG_S

from mavfi_cli.cli.gate import gate as gate_command
from mavfi_cli.cli.train import train as train_command
from mavfi_cli.core import installed
from mavfi_cli.core.errors import MavfiError, ModelError
from mavfi_cli.core.types import Command, StackMark, Trajectory
from mavfi_cli.detect import base
from mavfi_cli.detect.base import PLUG_INS
from mavfi_cli.detect.fit import fit
from mavfi_cli.detect.offline import Dataset, FlightSamples
from mavfi_cli.detect.preprocess import PreprocessParams, span
from mavfi_cli.link.codec import Codec, Signing, dialect, frame_of, key_from_passphrase
from mavfi_cli.link.router import Side
from mavfi_cli.link.telemetry import Telemetry
from mavfi_cli.link.tlog import TlogWriter
from mavfi_cli.mission import gate_process, setpoint_gate
from mavfi_cli.mission.setpoint_gate import SetpointGate
from mavfi_cli.mission.setpoints import SetpointView, command_of, samples_of_tlog
from mavfi_cli.spec.companion import CompanionConfig, GateConfig
from mavfi_cli.spec.detector import DetectorConfig
from mavfi_cli.studies.train import _mark_of

MARK = StackMark(name="companion:hop", digest="1")
VELOCITY = 0b1101_1100_0111


def received(message, system=1, component=191):
    frame = Codec(system, component).encode(message)
    return Codec(0, 0, keeps_unknown=True).decode(frame)[0]


def setpoint(vx=2.0, *, mask=VELOCITY, frame=1, stamp_ms=0, **fields):
    values = dict.fromkeys(("x", "y", "z", "vy", "vz", "afx", "afy", "afz", "yaw", "yaw_rate"), 0.0)
    values |= {"vx": vx, **fields}
    order = ("x", "y", "z", "vx", "vy", "vz", "afx", "afy", "afz", "yaw", "yaw_rate")
    return received(
        dialect.MAVLink_set_position_target_local_ned_message(
            stamp_ms, 1, 1, frame, mask, *(values[name] for name in order)
        )
    )


def states(stamp_ms, north_m=0.0):
    """A heartbeat, an attitude (facing north) and a position of the autopilot."""
    heartbeat = dialect.MAVLink_heartbeat_message(2, 12, 129, 6 << 16, 4, 3)
    attitude = dialect.MAVLink_attitude_message(stamp_ms, 0, 0, 0, 0, 0, 0)
    place = dialect.MAVLink_local_position_ned_message(stamp_ms, north_m, 0, -5, 2, 0, 0)
    return [received(message, component=1) for message in (heartbeat, attitude, place)]


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """A range model of flights at 0 to 2 m/s."""

    def flight(seed):
        def ticks():
            for number in range(40):
                velocity = np.array([0.0, 0.0 if number < 5 else 2.0, 0.0])
                row = [0.0, 0.1 * number, 5.0, 0.5 * math.pi, 0.0, 2.0, 0.0, 0.0, 0.0, 0.0]
                plan = Trajectory(
                    stamp_s=number * 0.1, waypoints=np.array([row]), durations_s=np.ones(1),
                    trajectory_seq=0, future_collision_seq=0,
                )  # fmt: skip
                yield (
                    number * 0.1,
                    plan,
                    Command(stamp_s=0.0, velocity_enu_mps=velocity, yaw_rad=0.5 * math.pi),
                )

        return FlightSamples.of_ticks(ticks(), "farm", seed)

    dataset = Dataset(
        flights=tuple(map(flight, range(10))), preprocess=PreprocessParams(), stack=MARK
    )
    path = tmp_path_factory.mktemp("model") / "range.json"
    fit("range", dataset).save(path)
    return path


@pytest.fixture
def gate(model):
    """A function that makes a gate; `said` are its notes."""

    def made(gone=str, mark=MARK, signing=None, **settings):
        notes = []
        detector = DetectorConfig(name="range", model=str(model))
        made = SetpointGate(
            detector,
            GateConfig(**settings),
            mark,
            note=lambda kind, text: notes.append(text),
            gone=gone,
            signing=signing,
        )
        made.said = notes
        for message in states(1000):
            assert made.pass_between(message, Side.AUTOPILOT, 1.0) == [message]
        assert made.pass_between(setpoint(), Side.COMPANION, 1.0)[0].vx == 2.0
        return made

    return made


def velocities(gate, values):
    """What passes in place of setpoints 0.1 s apart."""
    return [
        [own.vx for own in gate.pass_between(setpoint(vx), Side.COMPANION, 1.0 + 0.1 * n)]
        for n, vx in enumerate(values, 1)
    ]


def test_a_wild_setpoint_is_held_back_then_braked_and_a_good_one_passes(gate):
    own = gate(patience=2)
    passed = velocities(own, [-1000.0, -1000.0, -1000.0, -1000.0, 2.0])
    assert passed == [[2.0], [2.0], [0.0], [0.0], [2.0]]
    summary = own.summary()
    assert summary["responses"] == {
        "hold": 2, "brake": 2, "autopilot": 0, "stale": 0, "none": 0,
    }  # fmt: skip
    assert summary["alarms"][0]["states"] == ["setpoint_vy"]
    texts = [m.text for frame in own.outbox for m in Codec(0, 0).decode(frame)]
    assert texts[0].startswith("mavfi gate: setpoint withheld")


def test_a_standstill_keeps_the_yaw_of_the_last_accepted_setpoint(model):
    own = SetpointGate(
        DetectorConfig(name="range", model=str(model)), GateConfig(action="brake"), MARK,
        note=print,
    )  # fmt: skip
    for message in states(1000):  # the vehicle faces north
        own.pass_between(message, Side.AUTOPILOT, 1.0)
    turned = {"mask": 0b1001_1100_0111, "yaw": 3.0}
    passed = [
        own.pass_between(setpoint(vx, **turned), Side.COMPANION, 1.1)[0].vx
        for vx in (2.0, -1000.0, 2.0)
    ]
    assert passed == [2.0, 0.0, 2.0]


class Steps:
    """A plug-in without a model: the largest step of any state of a stage, in codes."""

    name, per_stage, threshold = "steps", True, 8.0

    def __init__(self, *, model, threshold):
        self.memory = {}

    def score(self, deltas, stage):
        first, end = span(stage)
        return float(np.abs(deltas[first:end].astype(int)).max())

    def learn(self, deltas, stage):
        pass


def test_a_plug_in_judges_setpoints(monkeypatch):
    entry = EntryPoint("steps", f"{__name__}:Steps", PLUG_INS.group)
    monkeypatch.setattr(installed, "entry_points", lambda group: EntryPoints([entry]))
    monkeypatch.setattr(base, "PLUG_INS", installed.PlugIns(PLUG_INS.group, "detector"))
    own = SetpointGate(DetectorConfig(name="steps"), GateConfig(), MARK, note=print)
    for message in states(1000):
        own.pass_between(message, Side.AUTOPILOT, 1.0)
    assert velocities(own, [2.0, 2.0, -1000.0, 2.0]) == [[2.0], [2.0], [2.0], [2.0]]
    assert own.summary()["responses"]["hold"] == 1


@pytest.mark.parametrize("wild", [math.nan, math.inf, -3e38])
def test_no_wild_number_passes(gate, wild):
    assert velocities(gate(action="brake"), [wild]) == [[0.0]]


def test_the_held_setpoint_has_the_header_and_time_of_the_withheld(gate):
    own = gate()
    wild = setpoint(-1000.0, stamp_ms=7)
    (held,) = own.pass_between(wild, Side.COMPANION, 1.1)
    (read,) = Codec(0, 0).decode(frame_of(held))
    assert (read.vx, read.time_boot_ms) == (2.0, 7)
    assert read.get_header().seq == wild.get_header().seq


def test_a_standstill_takes_the_place_of_a_signed_setpoint_of_another_kind(gate):
    key = key_from_passphrase("secret")
    sender = Codec(1, 191, signing=Signing(key, lambda: 1.7e9))
    attitude = dialect.MAVLink_set_attitude_target_message(0, 1, 1, 0, [1, 0, 0, 0], 9, 9, 9, 0.5)
    (wild,) = Codec(0, 0).decode(sender.encode(attitude))
    own = gate(action="brake", signing=Signing(key, time.time))
    (still,) = own.pass_between(wild, Side.COMPANION, 1.1)
    (read,) = Codec(0, 0, signing=Signing(key, lambda: 1.7e9)).decode(frame_of(still))
    assert (read.get_type(), read.vx) == ("SET_POSITION_TARGET_LOCAL_NED", 0.0)
    assert (read.get_srcComponent(), read.get_header().seq) == (191, wild.get_header().seq)
    assert frame_of(still)[-13:-6] == frame_of(wild)[-13:-6]  # link id and signing time
    assert gate(action="brake").pass_between(wild, Side.COMPANION, 1.1) == []


def test_the_autopilot_is_told_to_hold_once_a_second(gate):
    own = gate(action="autopilot")
    assert velocities(own, [-1000.0] * 5) == [[]] * 5
    sent = [m for frame in own.outbox for m in Codec(0, 0).decode(frame)]
    (command,) = [m for m in sent if m.get_type() == "COMMAND_LONG"]
    assert (command.command, command.param2, command.param3) == (176, 4.0, 3.0)  # AUTO.LOITER


def test_watching_only_reports(gate):
    own = gate(watch_only=True)
    assert velocities(own, [-1000.0, 2.0]) == [[-1000.0], [2.0]]
    summary = own.summary()
    assert (len(summary["alarms"]), summary["alarm_count"]) == (2, 2)
    assert {name for name, count in summary["responses"].items() if count} == {"none"}
    assert "reported" in own.said[0]
    gone = gate(watch_only=True, gone=lambda: "the program script is gone")
    assert velocities(gone, [2.0] * 12) == [[2.0]] * 12
    summary = gone.summary()
    assert (summary["responses"]["stale"], summary["alarm_count"]) == (3, 0)


def test_setpoints_that_pass_again_are_told_even_after_a_short_alarm(gate):
    own = gate()
    assert velocities(own, [-1000.0, 2.0, 2.0]) == [[2.0]] * 3
    assert own.said[-1].startswith("setpoint withheld")
    own.pass_between(setpoint(), Side.COMPANION, 9.0)
    own.pass_between(setpoint(), Side.COMPANION, 19.0)
    assert own.said[1:] == ["setpoints pass again"]


def test_setpoints_of_a_companion_that_is_gone_end_once_they_no_longer_change(gate):
    own = gate(gone=lambda: "the program script is gone")
    assert velocities(own, [2.0] * 12) == [[2.0]] * 9 + [[]] * 3
    assert velocities(gate(), [2.0] * 12) == [[2.0]] * 12
    silent = gate()
    heartbeat = received(dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 0, 3))
    assert silent.pass_between(heartbeat, Side.COMPANION, 1.0) == [heartbeat]
    other = received(dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 0, 3), component=190)
    silent.pass_between(other, Side.COMPANION, 3.5)  # says nothing about the setpoints' sender
    assert velocities(silent, [2.0] * 35) == [[2.0]] * 30 + [[]] * 5


def test_setpoints_of_a_gone_companion_are_told_once_then_every_minute(gate):
    own = gate(gone=lambda: "the program script is gone")
    for tick in range(1300):
        own.pass_between(setpoint(), Side.COMPANION, 2.0 + 0.1 * tick)
    assert own.said == ["the program script is gone: its setpoints are withheld"] * 3
    own.pass_between(setpoint(1.0), Side.COMPANION, 140.0)  # it is back
    own.pass_between(setpoint(1.0), Side.COMPANION, 142.0)
    assert len(own.said) == 4


@pytest.mark.parametrize("component", [190, 191])
def test_setpoints_of_a_gone_companion_end_beside_those_of_another_commander(gate, component):
    own, peer, another = gate(gone=lambda: "the program script is gone"), object(), object()
    passed = []
    for tick in range(1, 14):
        for sender, ids, vx in ((peer, 191, 2.0), (another, component, 0.1 * tick)):
            now_s = 1.0 + 0.1 * tick
            message = received(setpoint(vx), component=ids)
            passed.append([m.vx for m in own.pass_between(message, Side.COMPANION, now_s, sender)])
    assert passed[::2] == [[2.0]] * 10 + [[]] * 3
    assert all(passed[1::2])
    also = "" if component == 190 else "also "
    assert own.said[0] == f"another commander, {also}1/{component}, sends setpoints"


def test_two_peers_with_the_same_ids_are_two_commanders_unless_one_succeeds_the_other(gate):
    own, first, second, third = gate(), object(), object(), object()

    def tell(*peers):
        for peer in peers:
            own.pass_between(setpoint(), Side.COMPANION, 2.0, peer)
        return own.said

    assert tell(first, first, second, second, third, None, third) == []  # started again, twice
    assert tell(second, third, second) == ["another commander, also 1/191, sends setpoints"]


def test_setpoints_without_the_vehicles_state_are_told_once(model):
    said = []
    detector = DetectorConfig(name="range", model=str(model))
    own = SetpointGate(detector, GateConfig(), MARK, note=lambda _, text: said.append(text))
    for tick in range(100):
        assert own.pass_between(setpoint(), Side.COMPANION, 0.1 * tick)
        assert bool(said) == (tick > 30)
    assert said == [setpoint_gate._BLIND]
    texts = [m.text for frame in own.outbox for m in Codec(0, 0).decode(frame)]
    assert "LOCAL_POSITION_NED" in "".join(texts)


def test_a_flood_of_senders_fills_no_memory(gate):
    own = gate()
    for system in range(1, 251):
        own.pass_between(received(setpoint(2.0), system=system), Side.COMPANION, 1.0)
    assert len(own._steady) == 16
    assert sum("another commander" in text for text in own.said) == 99


@pytest.mark.parametrize(("on_error", "passed"), [("open", [[2.0]]), ("closed", [[]])])
def test_an_error_in_the_gate_fails_as_configured(gate, on_error, passed):
    own = gate(on_error=on_error)
    own._gate.judge_tick = None
    assert velocities(own, [2.0]) == passed
    assert f"fails {on_error}" in own.said[0]


def test_a_model_of_another_companion_is_refused(gate, tmp_path):
    with pytest.raises(ModelError, match="not to 'companion:other'"):
        gate(mark=StackMark(name="companion:other", digest="2"))
    with pytest.raises(ModelError, match="needs --model"):
        DetectorConfig(name="gad").build_for_companion(MARK)
    marks = [CompanionConfig.load(command).mark.digest for command in ("true", "true 1")]
    assert marks[0] != marks[1]


def test_setpoints_of_every_kind_are_read_in_the_world_frame():
    view = SetpointView()
    for message in states(1000, north_m=3.0):
        view.hear(message)
    view.hear(received(dialect.MAVLink_global_position_int_message(
        1000, 470000000, 80000000, 500000, 5000, 0, 0, 0, 0), component=1))  # fmt: skip

    def read(message):
        command = view.sample(message)[2]
        return [*np.round(command.velocity_enu_mps, 3).tolist(), round(command.yaw_rad, 3)]

    north = round(0.5 * math.pi, 3)
    assert read(setpoint(1.0, vy=2.0, vz=3.0)) == [2.0, 1.0, -3.0, north]
    assert read(setpoint(1.0, vy=2.0, frame=8)) == [2.0, 1.0, 0.0, north]
    position = 0b1101_1111_1000
    assert read(setpoint(mask=position, x=13.0, y=4.0, z=-6.0)) == [4.0, 10.0, 1.0, north]
    assert read(setpoint(mask=0b1001_1100_0111, yaw=0.5)) == [0.0, 2.0, 0.0, round(north - 0.5, 3)]
    place = dialect.MAVLink_set_position_target_global_int_message(
        0, 1, 1, 6, position, 470000900, 80000000, 7.0, *[0.0] * 8
    )
    assert read(received(place)) == [0.0, 10.019, 2.0, north]
    attitude = dialect.MAVLink_set_attitude_target_message(
        0, 1, 1, 0, [math.cos(0.1), math.sin(0.1), 0, 0], 0, 0, 0, 0.5
    )
    assert read(received(attitude)) == [0.2, 0.0, 0.5, 0.0]
    rates = dialect.MAVLink_set_attitude_target_message(
        0, 1, 1, 128, [math.nan] * 4, 0.3, -0.2, 0.1, 0.5
    )
    assert read(received(rates)) == [0.3, -0.2, 0.5, 0.1]
    assert math.isnan(command_of(setpoint(math.nan), Telemetry()).velocity_enu_mps[1])


def test_altitudes_above_the_ground_and_positions_of_other_senders():
    view = SetpointView()
    for message in states(1000):
        view.hear(message)
    for component, altitude_mm in ((1, 500000), (100, 0)):
        here = dialect.MAVLink_global_position_int_message(
            1000, 470000000, 80000000, altitude_mm, 5000, 0, 0, 0, 0
        )
        view.hear(received(here, component=component))
    for frame, up_m in ((11, 2.0), (6, 2.0), (5, 7.0 - 500.0)):
        place = dialect.MAVLink_set_position_target_global_int_message(
            0, 1, 1, frame, 0b1101_1111_1000, 470000000, 80000000, 7.0, *[0.0] * 8
        )
        assert view.sample(received(place))[2].velocity_enu_mps[2] == pytest.approx(up_m)


@pytest.mark.parametrize(("autopilot", "turned", "moved"), [(12, True, 0.0), (3, False, 5.0)])
def test_a_body_frame_is_read_as_the_autopilot_reads_it(autopilot, turned, moved):
    """PX4 takes the yaw as absolute and ignores positions; ArduCopter takes both as offsets."""
    heartbeat = dialect.MAVLink_heartbeat_message(2, autopilot, 129, 0, 4, 3)
    attitude = dialect.MAVLink_attitude_message(1000, 0, 0, 1.0, 0, 0, 0)
    view = SetpointView()
    for message in (heartbeat, attitude):
        view.hear(received(message, component=1))
    for message in states(1000)[2:]:
        view.hear(message)
    command = view.sample(setpoint(0.0, mask=0b1001_1100_0000, frame=8, x=5.0, yaw=0.25))[2]
    yaw_rad = 0.5 * math.pi - (0.25 if turned else 1.25)
    assert command.yaw_rad == pytest.approx(yaw_rad)
    assert np.linalg.norm(command.velocity_enu_mps) == pytest.approx(moved)


def test_a_tlog_gives_the_samples_of_its_setpoints(tmp_path):
    log = TlogWriter(0)
    log.open(tmp_path / "flight.tlog")
    for number in range(3):
        for message in (*states(1000 + 20 * number), setpoint(1.0 * number)):
            log.write(number, frame_of(message))
    log.close()
    samples = samples_of_tlog(tmp_path / "flight.tlog", "flight", 1)
    assert samples.deltas.shape == (3, 13)
    assert samples.new_waypoint.all()
    assert samples.deltas[:, 10].tolist() == [0, 3, 1]  # 0, 1 and 2 m/s north


def test_a_process_is_gone_before_its_parent_has_awaited_it():
    process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    try:
        assert gate_process._Watch(str(process.pid)).gone() == ""
        process.stdin.close()
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        assert "is gone" in gate_process._Watch(str(process.pid)).gone()
    finally:
        process.wait()


@pytest.mark.parametrize("text", [None, "seven\n"])
def test_a_file_that_names_no_process_is_called_so(tmp_path, text):
    path = tmp_path / "mine.pid"
    if text is not None:
        path.write_text(text)
    done = CliRunner().invoke(gate_command, ["--process", str(path)])
    assert isinstance(done.exception, MavfiError)
    problem = "No such file or directory" if text is None else "not a number"
    assert str(done.exception) == f"the companion's process is unknown ({path}: {problem})"


def test_a_process_that_has_ended_stays_gone_although_its_id_is_used_again(tmp_path, monkeypatch):
    process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    monkeypatch.setattr(gate_process, "_LOOK_S", 0.0)
    path = tmp_path / "script.pid"
    path.write_text(f"{process.pid}\n")
    watch = gate_process._Watch(str(path))
    assert watch.gone() == ""
    process.stdin.close()
    process.wait()
    assert "is gone" in watch.gone()
    monkeypatch.setattr(gate_process, "EndWatch", lambda pid: pytest.fail("looked up again"))
    assert "is gone" in watch.gone()
    monkeypatch.undo()
    path.write_text(f"{os.getpid()}\n")
    watch._next_s = 0.0
    assert watch.gone() == ""


def test_an_unexpected_error_ends_the_worker_and_not_the_gate(monkeypatch):
    worker = gate_process._Worker(None, None, None, None)
    monkeypatch.setattr(worker, "_route", lambda alive, judges: 1 / 0)
    assert gate_process._watched(worker, (), judges=True) is None
    monkeypatch.setattr(worker, "_route", lambda alive, judges: None)
    assert gate_process._watched(worker, (), judges=True) == 0


@contextlib.contextmanager
def running(model, *options):
    """`mavfi gate` between two sockets of this test: the autopilot's and the companion's."""
    autopilot = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    autopilot.bind(("127.0.0.1", 0))
    autopilot.settimeout(LONG_S)
    companion = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    companion.settimeout(LONG_S)
    url = f"udpout:127.0.0.1:{autopilot.getsockname()[1]}"
    process = subprocess.Popen(
        [sys.executable, "-m", "mavfi_cli", "gate", "--autopilot", url, "--to",
         "udpin:127.0.0.1:0", "--detector", "range", "--model", str(model), *options],
        stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        line = process.stderr.readline()
        assert "ready" in line, line
        companion.connect(("127.0.0.1", int(line.split()[-1])))
        yield process, autopilot, companion
    finally:
        process.terminate()
        process.wait(LONG_S)
        process.stderr.close()
        autopilot.close()
        companion.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fails", "end"),
    [("open", signal.SIGKILL), ("closed", signal.SIGKILL), ("closed", signal.SIGSTOP)],
)
def test_the_gate_passes_frames_byte_for_byte_and_fails_as_configured(model, fails, end, tmp_path):
    log = tmp_path / "log.jsonl"
    with running(model, "--fail", fails, "--log", str(log)) as (process, autopilot, companion):
        heartbeat = frame_of(received(dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 0, 3)))
        good, wild = (frame_of(setpoint(vx)) for vx in (2.0, -1000.0))
        texts = []

        def passed():
            """Return the next frame that is none of the gate's own texts."""
            while True:
                data, _ = autopilot.recvfrom(1000)
                (message,) = Codec(0, 0).decode(data)
                if message.get_type() != "STATUSTEXT":
                    return data
                texts.append(message.text)

        def through(frame):
            companion.send(frame)
            return passed()

        assert through(heartbeat) == heartbeat
        assert through(good) == good
        assert Codec(0, 0).decode(through(wild))[0].vx == 2.0
        children = f"/proc/{process.pid}/task/{process.pid}/children"
        with open(children) as file:
            worker = int(file.read().split()[0])
        os.kill(worker, end)
        time.sleep(1.0 if end is signal.SIGKILL else 2.5)  # a worker may hang for 1 s
        companion.send(heartbeat)
        assert through(heartbeat) == heartbeat
        companion.send(wild)
        companion.send(heartbeat)
        data = passed()
        while data == heartbeat and fails == "open":
            data = passed()
        assert data == (wild if fails == "open" else heartbeat)
        assert f"mavfi gate: failed {fails}" in "".join(texts)
    assert f"has failed {fails}" in log.read_text()


def test_the_gate_runs_on_a_board_without_the_packages_of_the_simulation(model):
    absent = ("jsbsim", "ompl", "fcl", "octomap", "pyarrow", "matplotlib", "capstone", "elftools",
              "rich", "scipy", "torch")  # fmt: skip
    code = (
        f"import sys; sys.modules.update(dict.fromkeys({absent!r}))\n"
        "from mavfi_cli.cli import main\nmain()"
    )
    arguments = ["gate", "--autopilot", "udpout:127.0.0.1:9", "--to", "udpin:127.0.0.1:0",
                 "--detector", "range", "--model", str(model)]  # fmt: skip
    process = subprocess.Popen(
        [sys.executable, "-c", code, *arguments], stderr=subprocess.PIPE, text=True
    )
    try:
        assert "the gate is ready" in process.stderr.readline()
    finally:
        process.terminate()
        process.communicate()


def test_a_companions_file_has_the_defaults_of_the_gate(tmp_path, monkeypatch):
    run = []
    monkeypatch.setattr(gate_process.GateProcess, "run", lambda gate: run.append(gate) or 0)
    path = tmp_path / "mine.toml"
    path.write_text(
        "key_file = 'key'\n[program.fly]\ncommand = 'not-here {link}'\n"
        "[gate]\naction = 'brake'\npatience = 2\n"
    )
    done = CliRunner().invoke(gate_command, ["--companion", str(path), "--patience", "3"])
    assert done.exit_code == 0, done.output
    (gate,) = run
    assert (gate.settings.action, gate.settings.patience) == ("brake", 3)
    assert gate.key_file == str(tmp_path / "key")
    assert gate.mark == CompanionConfig.load(str(path), starts=False).mark


def test_a_model_from_logs_belongs_to_the_companion_that_is_named(tmp_path, monkeypatch):
    log = tmp_path / "flight.tlog"
    log.write_bytes(b"")
    plans = []
    monkeypatch.setattr("mavfi_cli.studies.train.train", lambda plan, *_: plans.append(plan))
    asked = ["--from", str(log), "--companion", "not-here {link}", "--quiet"]
    CliRunner().invoke(train_command, [*asked, "--out", str(tmp_path / "out")])
    (plan,) = plans
    assert plan.logs == (log,)
    assert _mark_of(plan) == CompanionConfig.load("not-here {link}", starts=False).mark
