"""Flights of a foreign companion in lockstep: they repeat, and end whatever the companion does."""

import os
import sys
from pathlib import Path

import pyarrow.compute as pc
import pytest
from missions import SHORT

from mavfi_cli import library
from mavfi_cli.core.errors import ConfigError
from mavfi_cli.detect.fit import fit
from mavfi_cli.detect.offline import Dataset
from mavfi_cli.detect.preprocess import PreprocessParams
from mavfi_cli.link.tlog import tlog_messages
from mavfi_cli.mission.setpoints import samples_of_tlog
from mavfi_cli.spec.companion import CompanionConfig
from mavfi_cli.spec.detector import DetectorConfig
from mavfi_cli.spec.fault import FaultConfig

EXAMPLES = Path(__file__).parents[2] / "examples" / "companions"
SETPOINT = "SET_POSITION_TARGET_LOCAL_NED"
# A client that answers the ticks before a stamp, then does something else.
CLIENT = """
import sys, time
from pymavlink import mavutil
until_ms, then = int(sys.argv[2]), sys.argv[3]
if until_ms == 0:
    exec(then)
link = mavutil.mavlink_connection(sys.argv[1], source_system=1, source_component=191)
while True:
    tick = link.recv_match(type="LOCAL_POSITION_NED", blocking=True)
    if tick.time_boot_ms >= until_ms:
        exec(then)
    for ms, command, first, second in ((5000, 176, 1, 6), (6000, 400, 1, 0)):
        if tick.time_boot_ms == ms:
            link.mav.command_long_send(1, 1, command, 0, first, second, 0, 0, 0, 0, 0)
    link.mav.set_position_target_local_ned_send(
        tick.time_boot_ms, 1, 1, 1, 3527, 0, 0, 0, 0, 0, -1, 0, 0, 0, 0, 0)
"""


@pytest.fixture
def fly(tmp_path, monkeypatch):
    """A function that flies a companion in lockstep: an example, or the client above."""
    scripts = Path(sys.executable).parent
    monkeypatch.setenv("PATH", f"{scripts}:{os.environ['PATH']}")
    (tmp_path / "client.py").write_text(CLIENT)

    def flown(companion="", until_ms=0, then="", limits="", **settings):
        if not companion:
            companion = str(tmp_path / "client.toml")
            Path(companion).write_text(
                f"time = 'lockstep'\n{limits}\n"
                f"program.client.command = 'python client.py {{link}} {until_ms} \"{then}\"'\n"
            )
        defaults = {"world": "farm", "time_limit_s": 60.0, "out": tmp_path / "runs"}
        return library.fly(companion=str(companion), **{**defaults, **settings})

    return flown


def record(run):
    """What two flights must share: the result without its host, the wire, and the truth."""
    result = {name: part for name, part in run.result.items() if name != "host"}
    return result, run.folder.tlog.read_bytes(), run.folder.trace.read_bytes()


@pytest.mark.slow
def test_two_flights_of_the_example_are_the_same_to_the_byte(fly):
    first, second = (fly(EXAMPLES / "lockstep.toml") for _ in range(2))
    assert (first.record.outcome, first.record.reason) == ("success", "landed")
    assert first.record.in_lockstep
    assert 12.0 < first.record.quality_of_flight.distance_m < 20.0
    assert first.trace["truth_x_m"].null_count == 0
    assert record(first) == record(second)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("until_ms", "then", "limits", "outcome", "reason"),
    [
        (8000, "raise OSError(7)", "", "crash", "client ended with code 1: OSError: 7"),
        (3000, "sys.exit(3)", "", "crash", "client ended with code 3"),
        (3000, "sys.exit(0)", "", "success", "client ended with code 0"),
        (3000, "time.sleep(60)", "answer_limit_s = 0.5", "hang", "at 3000 ms within 0.5 s"),
        (3000, "link.close(); time.sleep(60)", "answer_limit_s = 0.5", "hang", "at 3000 ms"),
        (0, "sys.exit(4)", "", "crash", "client ended with code 4 before it was ready"),
        (0, "time.sleep(60)", "program.client.ready_limit_s = 0.5", "crash", "not ready within"),
    ],
)  # fmt: skip
def test_a_companion_that_ends_or_is_silent_never_hangs_the_flight(
    fly, until_ms, then, limits, outcome, reason
):
    run = fly(until_ms=until_ms, then=then, limits=limits)
    assert run.record.outcome == outcome
    assert reason in run.record.reason
    if until_ms == 3000:  # a heartbeat must tell what a program that failed has done last
        waited_s = 2.02 if outcome == "crash" else 0.0
        assert run.result["simulated_s"] == pytest.approx(3.0 + waited_s)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("target", "effect"),
    [
        ("process.client", "flip"),
        (SETPOINT, "drop"),
        (SETPOINT, "swap"),
        (SETPOINT, "twice"),
        (f"{SETPOINT}.time_boot_ms", "flip"),
        ("LOCAL_POSITION_NED", "drop"),
        ("LOCAL_POSITION_NED", "late=0.1"),
        ("LOCAL_POSITION_NED.time_boot_ms", "flip"),
    ],
)
def test_a_fault_repeats_and_does_not_stop_the_clock(fly, target, effect):
    fault = FaultConfig(target=target, effect=effect, at="time=2")
    first, second = (
        fly(until_ms=10_000, then="sys.exit(0)", fault=fault, limits="answer_limit_s = 20")
        for _ in range(2)
    )
    assert first.result["simulated_s"] > 8.5
    assert first.record.strikes
    assert record(first) == record(second)


@pytest.mark.slow
def test_a_gate_holds_back_a_wild_setpoint_and_the_clock_goes_on(fly, tmp_path):
    companion = EXAMPLES / "lockstep.toml"
    learned = fly(companion)
    flights = tuple(samples_of_tlog(learned.folder.tlog, "farm", seed) for seed in range(10))
    mark = CompanionConfig.load(str(companion)).mark
    model = tmp_path / "range.json"
    fit("range", Dataset(flights=flights, preprocess=PreprocessParams(), stack=mark)).save(model)
    wild = FaultConfig(  # 2 m/s become 512 m/s
        target=f"{SETPOINT}.vx", at="time=6", exact_bits=(26,), persistence="stuck-at",
        duration_s=0.5,
    )  # fmt: skip
    gate = DetectorConfig(name="range", model=str(model))
    bare, *guarded = (fly(companion, fault=wild, detector=own) for own in (None, gate, gate))
    assert bare.record.detection is None
    assert guarded[0].record.detection.responses["hold"] > 0
    assert guarded[0].record.outcome == "success"
    assert record(guarded[0]) == record(guarded[1])
    ends_m = [run.trace["truth_y_m"].to_numpy()[-1] for run in (learned, bare, guarded[0])]
    assert ends_m[1] > ends_m[0] + 1.0
    assert ends_m[0] - 1.5 < ends_m[2] < ends_m[0] + 0.1  # it holds, then brakes


@pytest.fixture
def way(tmp_path):
    """The settings of a short flight."""
    return {
        "world": "farm", "seed": SHORT.seed, "start": SHORT.start, "goal": SHORT.goal,
        "out": tmp_path / "runs",
    }  # fmt: skip


@pytest.mark.slow
def test_our_own_companion_flies_the_same_as_a_foreign_program(fly, way):
    foreign, own = fly(EXAMPLES / "mavfi-lockstep.toml", **way), library.fly(**way)
    assert foreign.record.outcome == own.record.outcome == "success"
    assert foreign.record.programs["mavfi"].codes == (0,)
    # The end of the program is noticed at the tick after its last setpoint.
    assert foreign.result["simulated_s"] == pytest.approx(own.result["simulated_s"] + 0.02)
    frames, own_frames = (
        [bytes(message.get_msgbuf()) for _, message in tlog_messages(run.folder.tlog)]
        for run in (foreign, own)
    )
    assert frames[: len(own_frames)] == own_frames
    assert len(frames) - len(own_frames) < 10
    flown = foreign.trace.filter(pc.is_in(foreign.trace["stamp_s"], own.trace["stamp_s"]))
    for name in own.trace.column_names:
        if name.startswith(("truth_", "power_")) or name in ("x_m", "y_m", "z_m", "stamp_s"):
            assert flown[name].equals(own.trace[name]), name


@pytest.mark.slow
def test_our_own_companion_reaches_the_goal_in_real_time(fly, way):
    run = fly(EXAMPLES / "mavfi.toml", **way)
    assert run.record.outcome == "success"
    place = [run.trace[f"truth_{axis}_m"].to_numpy()[-1] for axis in "xy"]  # it has landed there
    assert place == pytest.approx(SHORT.goal[:2], abs=1.5)


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("link = 'udpin:127.0.0.1:0'\n[program.a]\ncommand = 'true'", "link"),
        ("[program.a]\ncommand = 'true'\n[program.b]\ncommand = 'true'", "program"),
        ("[program.a]\ncommand = 'true'\nrestart = 'always'", "program.a.restart"),
        ("[program.a]\ncommand = 'true'\nshare = 0.5", "program.a.share"),
        ("[program.a]\ncommand = 'true'\nready_port = 5000", "program.a.ready_port"),
        ("answer_limit_s = 0.0\n[program.a]\ncommand = 'true'", "answer_limit_s"),
    ],
)
def test_what_only_the_wall_clock_could_decide_is_refused(tmp_path, text, key):
    path = tmp_path / "companion.toml"
    path.write_text(f"time = 'lockstep'\n{text}")
    with pytest.raises(ConfigError, match=key):
        CompanionConfig.load(str(path))


@pytest.mark.parametrize(
    ("settings", "key"),
    [
        ({"speed": 2.0}, "speed"),
        ({"fault": FaultConfig(target="process.client", effect="stop")}, "effect"),
        ({"autopilot": "px4", "firmware": "/bin/true"}, "autopilot"),
    ],
)
def test_a_mission_that_needs_the_wall_clock_is_refused(fly, settings, key):
    with pytest.raises(ConfigError) as refusal:
        fly(until_ms=1000, then="pass", **settings)
    assert refusal.value.key == key
