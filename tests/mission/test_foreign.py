"""Missions with an autopilot at the far end of a UDP socket."""

import json
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import fake_autopilot
import numpy as np
import pymavlink
import pytest
from fake_autopilot import FakeArduCopter, FakePX4
from mcap.reader import make_reader

from mavfi_cli.autonomy import warm
from mavfi_cli.core.errors import CommandRefused, ConfigError, Interrupted, LinkError, NoAutopilot
from mavfi_cli.link.codec import Codec, dialect
from mavfi_cli.link.session import SessionSettings
from mavfi_cli.mission import flight
from mavfi_cli.mission.run_folder import load_run
from mavfi_cli.report.view.entries import ViewedFlight
from mavfi_cli.report.view.mcap_file import write_mcap

MAVLOGDUMP = Path(pymavlink.__file__).parent / "tools" / "mavlogdump.py"


def dumped_stamps(tlog):
    """Unix time of every record, as mavlogdump reads them."""
    line = [sys.executable, MAVLOGDUMP, "--format", "json", "--types", "HEARTBEAT", str(tlog)]
    done = subprocess.run(line, capture_output=True, text=True, check=True)
    found = [json.loads(text) for text in done.stdout.splitlines() if text.startswith("{")]
    return [each["meta"]["timestamp"] for each in found]


def summary_of(path):
    with path.open("rb") as stream:
        return make_reader(stream).get_summary().statistics


@pytest.mark.slow
def test_the_whole_mission_over_a_real_udp_socket(sitl_on_udp, fly_short, at_event, tmp_path):
    watcher = at_event("", None)
    begun = time.time()
    run = load_run(fly_short(watcher, link=sitl_on_udp, start=None, land=True).path)
    dates = dumped_stamps(run.folder.tlog)
    assert begun <= dates[0] < dates[-1] <= time.time()
    write_mcap([ViewedFlight(name="flight", run=run, recorder=None)], tmp_path / "flight.mcap")
    told = summary_of(tmp_path / "flight.mcap")
    assert begun <= told.message_start_time / 1e9 <= time.time()
    assert run.result["outcome"] == "success"
    assert run.result["referee"] is None
    assert run.result["world"] is None
    assert run.folder.path.name.startswith("link-")
    assert [e.text for e in watcher.events if e.kind == "phase"] == [
        "connecting", "waiting until ready", "arming", "taking off", "offboard", "landing", "done",
    ]  # fmt: skip
    names = ("x_m", "y_m", "z_m")
    heard = np.column_stack([run.trace[name].to_numpy() for name in names])
    quality = run.result["quality_of_flight"]
    distance_m = np.linalg.norm(np.diff(heard, axis=0), axis=1).sum()
    assert quality["distance_m"] == pytest.approx(distance_m)
    assert quality["goal_distance_m"] <= 1.1
    assert quality["energy_regression_j"] is None
    assert quality["min_clearance_m"] is None


def test_a_goal_must_be_named(fly_short, free_port):
    with pytest.raises(ConfigError, match="needs --goal"):
        fly_short(link=f"udpin:127.0.0.1:{free_port}", goal=None)


@pytest.fixture
def soon_given_up(monkeypatch):
    """Nobody is waited for longer than 0.3 s."""
    settings = flight.SessionSettings
    monkeypatch.setattr(flight, "SessionSettings", lambda **o: settings(connect_timeout_s=0.3, **o))


def test_nobody_there(fly_short, free_port, soon_given_up):
    assert SessionSettings().connect_timeout_s == 10.0
    url = f"udpin:127.0.0.1:{free_port}"
    with pytest.raises(NoAutopilot, match=f"no autopilot at {url}"):
        fly_short(link=url)


def test_ctrl_c_while_it_waits_for_somebody(fly_short, free_port, monkeypatch):
    """The first thing that the flight sends, nobody hears: that is the moment."""
    real = flight.RecordedLink.send

    def send(self, messages, stamp_s):
        signal.raise_signal(signal.SIGINT)
        real(self, messages, stamp_s)

    monkeypatch.setattr(flight.RecordedLink, "send", send)
    with pytest.raises(Interrupted):
        fly_short(link=f"udpin:127.0.0.1:{free_port}")


def test_an_autopilot_that_refuses_to_arm_says_why(autopilot_on_udp, fly_short):
    autopilot = FakePX4()
    autopilot.refuse_arming = "Preflight Fail: ekf2 missing data\t"
    _, url = autopilot_on_udp(autopilot)
    with pytest.raises(CommandRefused, match=r"arming: .*\(Preflight Fail: ekf2 missing data\)"):
        fly_short(link=url)


@pytest.mark.parametrize("autopilot", [FakePX4, FakeArduCopter])
def test_the_time_limit_ends_a_flight(autopilot, autopilot_on_udp, fly_short):
    _, url = autopilot_on_udp(autopilot())
    run = load_run(fly_short(link=url, time_limit_s=1.0).path)
    assert run.result["outcome"] == "timeout"
    assert run.result["images"]["received"] > 0


@pytest.mark.parametrize("autopilot", [FakePX4, FakeArduCopter])
def test_nobody_takes_off_without_a_camera(autopilot, autopilot_on_udp, fly_short):
    fake = autopilot()
    _, url = autopilot_on_udp(fake, camera=False)
    with pytest.raises(LinkError, match=rf"{url}: no camera .* answered within 5 s"):
        fly_short(link=url)
    assert dialect.MAV_CMD_COMPONENT_ARM_DISARM not in [each.command for each in fake.commands]


def test_a_camera_that_falls_silent_in_flight_ends_it_on_the_ground(
    autopilot_on_udp, fly_short, at_event
):
    fake = FakePX4()
    link, url = autopilot_on_udp(fake)

    def go_blind():
        link.camera = None

    result = load_run(fly_short(at_event("offboard", go_blind), link=url, land=True).path).result
    assert result["outcome"] == "link_lost"
    assert re.search("camera .* 5 s", result["reason"])
    assert not fake.armed


def test_a_second_autopilot_on_the_link_is_told_before_take_off(autopilot_on_udp, fly_short):
    """As a router does that joins two vehicles' links."""
    fake = FakePX4()
    link, url = autopilot_on_udp(fake)
    other = Codec(9, 1).encode(dialect.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3))
    link.noise = lambda: other if fake.commands else b"\0"
    with pytest.raises(LinkError, match=r"two autopilots .*systems"):
        fly_short(link=url)
    assert not fake.armed


@pytest.mark.parametrize("eyes", [False, True])
def test_a_second_autopilot_at_another_address_is_told_before_take_off(
    autopilot_on_udp, fly_short, eyes
):
    """Both are system 1, as two simulators are that somebody has started at once."""
    fakes = FakePX4(), FakePX4()
    _, url = autopilot_on_udp(fakes[0], camera=not eyes)
    autopilot_on_udp(fakes[1], camera=False)
    place = r"127\.0\.0\.1:\d+"
    with pytest.raises(LinkError, match=f"two autopilots send here, {place} and {place}"):
        fly_short(link=url, **(EYES if eyes else {}))
    assert not any(fake.armed for fake in fakes)


@pytest.mark.parametrize(
    ("kind", "autopilot", "said"),
    [
        (1, 3, "MAV_AUTOPILOT_ARDUPILOTMEGA with MAV_TYPE_FIXED_WING"),
        (2, 14, "MAV_AUTOPILOT_AUTOQUAD with MAV_TYPE_QUADROTOR"),
        (2, 99, "MAV_AUTOPILOT 99 with MAV_TYPE_QUADROTOR"),
    ],
)
def test_an_autopilot_of_an_unknown_type_is_not_flown(
    autopilot_on_udp, fly_short, kind, autopilot, said
):
    link, url = autopilot_on_udp(FakePX4(), camera=False)
    link.muted |= {*EVERYTHING}
    link.noise = lambda: Codec(1, 1).encode(
        dialect.MAVLink_heartbeat_message(kind, autopilot, 0, 0, 3, 3)
    )
    with pytest.raises(LinkError, match=rf"{url}: system 1 must be PX4 .*, got {said}"):
        fly_short(link=url)


# With --eyes -----------------------------------------------------------------------------------

EYES = {"eyes": True, "world": "farm"}


@pytest.mark.slow
@pytest.mark.parametrize("autopilot", [FakePX4, FakeArduCopter])
def test_eyes_bring_camera_world_and_referee(autopilot, autopilot_on_udp, fly_short):
    """The autopilot stands at its local origin, which is the world's start: goals are the world's.

    A second flight begins where the first has landed.
    """
    fake = autopilot()
    _, url = autopilot_on_udp(fake, camera=False)
    there = load_run(fly_short(link=url, land=True, **EYES).path)
    assert there.result["outcome"] == "success", there.result["reason"]
    assert there.result["referee"]["pose"] == "the autopilot's own pose"
    assert there.result["referee"]["collision"] is None
    assert there.result["world"]["start"] == [2.0, 2.0, 0.0]
    assert there.result["config"]["eyes"] is True
    quality = there.result["quality_of_flight"]
    assert quality["min_clearance_m"] > 1.0
    assert quality["energy_regression_j"] > 0.0
    assert quality["energy_propeller_j"] is None
    assert there.trace["x_m"][0].as_py() == pytest.approx(2.0, abs=0.5)
    assert fake.position_enu_m[:2] == pytest.approx([8.0, 4.0], abs=1.5)
    back = load_run(fly_short(link=url, goal=(3.0, 3.0, 5.0), land=True, **EYES).path)
    assert back.result["outcome"] == "success", back.result["reason"]
    assert fake.position_enu_m[:2] == pytest.approx([1.0, 1.0], abs=1.5)
    flown_s = [each.result["simulated_s"] for each in (there, back)]
    assert sum(flown_s) < fake.stamp_s  # the clock of the second began where the first had ended


@pytest.mark.slow
def test_a_given_origin_holds(autopilot_on_udp, fly_short):
    _, url = autopilot_on_udp(FakePX4(), camera=False)
    run = load_run(fly_short(link=url, origin=(9.0, 3.0, 0.0), time_limit_s=1.0, **EYES).path)
    assert run.trace["x_m"][0].as_py() == pytest.approx(9.0, abs=0.5)


@pytest.mark.slow
def test_a_foreign_flight_into_a_box_is_a_collision(autopilot_on_udp, fly_short, tmp_path):
    """Nothing stops a scripted autopilot at a wall that is not in its world but in the camera's."""
    world = tmp_path / "wall.toml"
    world.write_text(
        'name = "wall"\nbounds_enu_m = [-10.0, -20.0, 0.0, 40.0, 20.0, 20.0]\n'
        "start_enu_m = [0.0, 0.0, 0.0]\ngoal_enu_m = [20.0, 0.0, 5.0]\n"
        "[[box]]\nmin_enu_m = [-1.0, 0.6, 4.0]\nmax_enu_m = [1.0, 3.0, 12.0]\n"
    )
    fake = FakePX4()
    _, url = autopilot_on_udp(fake, camera=False)
    drift = fake._move

    def blown():
        drift()
        if fake.mode == "OFFBOARD":
            fake.position_enu_m[1] += 0.04

    fake._move = blown
    run = load_run(
        fly_short(
            link=url, eyes=True, world=str(world), start=None, goal=None, land=True
        ).path
    )  # fmt: skip
    assert (run.result["outcome"], run.result["reason"][:5]) == ("collision", "box 0")
    assert run.result["referee"]["collision"]["what"] == "box 0"
    assert not fake.armed  # it has landed


def cut(link, *kinds):
    return lambda: link.muted.update(kinds)


EVERYTHING = ("HEARTBEAT", "LOCAL_POSITION_NED", "ATTITUDE_QUATERNION", "SYS_STATUS",
              "EXTENDED_SYS_STATE", "HOME_POSITION", "COMMAND_ACK", "STATUSTEXT")  # fmt: skip


def test_a_stream_that_stops_in_flight_is_a_lost_link(autopilot_on_udp, fly_short, at_event):
    link, url = autopilot_on_udp(FakePX4())
    folder = fly_short(at_event("offboard", cut(link, *EVERYTHING)), link=url, loss_limit_s=0.3)
    result = load_run(folder.path).result
    assert result["outcome"] == "link_lost"
    assert result["reason"] == f"{url}: no new state for 0.3 s"


def test_states_that_stop_while_the_rest_goes_on_are_a_lost_link(
    autopilot_on_udp, fly_short, at_event
):
    """There never is a silence, only nothing to fly by."""
    link, url = autopilot_on_udp(FakePX4())
    link.extra.append(dialect.MAVLink_vfr_hud_message(0, 0, 0, 0, 0, 0))
    folder = fly_short(
        at_event("offboard", cut(link, "LOCAL_POSITION_NED")), link=url, loss_limit_s=0.3
    )
    result = load_run(folder.path).result
    assert result["outcome"] == "link_lost"
    assert "no new state" in result["reason"]


def test_heartbeats_that_stop_are_no_lost_link(autopilot_on_udp, fly_short, at_event):
    """Everything else of the autopilot is still heard."""
    link, url = autopilot_on_udp(FakePX4())
    watcher = at_event("offboard", cut(link, "HEARTBEAT"))
    folder = fly_short(watcher, link=url, loss_limit_s=0.5, time_limit_s=3.0)
    assert load_run(folder.path).result["outcome"] == "timeout"


@pytest.mark.slow
def test_a_simulator_slower_than_real_time_is_no_lost_link(
    autopilot_on_udp, fly_short, at_event, monkeypatch
):
    """A state every 0.3 s of the wall's clock, 0.1 s of the vehicle's."""
    link, url = autopilot_on_udp(FakePX4())

    def slow():
        monkeypatch.setattr(fake_autopilot, "DT_S", 0.1)
        link.pause_s = 0.3

    watcher = at_event("offboard", slow)
    folder = fly_short(watcher, link=url, loss_limit_s=1.0, time_limit_s=2.0)
    result = load_run(folder.path).result
    assert (result["outcome"], result["config"]["loss_limit_s"]) == ("timeout", 1.0)
    assert result["host"]["flight_wall_s"] > 3 * result["config"]["time_limit_s"]


def test_an_autopilot_that_talks_much_but_tells_no_position_is_not_waited_for_for_ever(
    autopilot_on_udp, fly_short, monkeypatch
):
    settings = flight.SessionSettings
    monkeypatch.setattr(flight, "SessionSettings", lambda **o: settings(ready_timeout_s=0.5, **o))
    link, url = autopilot_on_udp(FakePX4())
    link.muted.add("LOCAL_POSITION_NED")
    link.extra.append(dialect.MAVLink_vfr_hud_message(0, 0, 0, 0, 0, 0))
    with pytest.raises(CommandRefused, match=r"no position and attitude within 0\.5 s"):
        fly_short(link=url)


def test_a_failsafe_is_told_in_the_autopilot_s_terms(autopilot_on_udp, fly_short, at_event):
    autopilot = FakePX4()
    _, url = autopilot_on_udp(autopilot)

    def failsafe():
        autopilot.tell("Failsafe activated: battery\t")
        autopilot.mode = "AUTO.RTL"

    run = load_run(fly_short(at_event("offboard", failsafe), link=url).path)
    assert run.result["outcome"] == "failsafe"
    assert "AUTO.RTL" in run.result["reason"]
    assert any("battery" in event["text"] for event in run.result["events"])


@pytest.fixture
def briefly_waited(monkeypatch):
    """Nobody waits longer than 3 s for a take-off or a landing."""
    settings = flight.SessionSettings
    monkeypatch.setattr(
        flight,
        "SessionSettings",
        lambda **o: settings(takeoff_timeout_s=6.0, land_timeout_s=6.0, **o),
    )


def test_a_command_refused_in_the_air_is_recorded_and_the_vehicle_lands(
    autopilot_on_udp, fly_short
):
    autopilot = FakePX4()
    autopilot.refuse_offboard = True
    _, url = autopilot_on_udp(autopilot)
    run = load_run(fly_short(link=url, land=True).path)
    assert run.result["outcome"] == "failsafe"
    reason = run.result["reason"]
    assert reason.startswith("autopilot refused mode OFFBOARD: ")
    assert "currently not available" in reason
    assert run.result["quality_of_flight"]["flight_time_s"] is None
    assert max(event["position_enu_m"][2] for event in run.result["events"][2:]) > 4.0
    assert [e["text"] for e in run.result["events"] if e["kind"] == "phase"][-2:] == [
        "landing", "done",
    ]  # fmt: skip
    assert not autopilot.armed


def test_a_climb_that_stops_is_recorded_and_the_vehicle_lands(
    autopilot_on_udp, fly_short, at_event, briefly_waited
):
    autopilot = FakeArduCopter()
    _, url = autopilot_on_udp(autopilot)
    climb = autopilot._move

    def stuck():
        climb()
        autopilot.position_enu_m[2] = min(autopilot.position_enu_m[2], 2.0)

    autopilot._move = stuck
    run = load_run(fly_short(link=url, land=True).path)
    assert run.result["outcome"] == "failsafe"
    assert "take-off: height not reached" in run.result["reason"]
    assert not autopilot.armed


def test_a_landing_that_is_refused_too_is_told_and_ends_the_mission(
    autopilot_on_udp, fly_short, briefly_waited
):
    autopilot = FakePX4()
    autopilot.refuse_offboard = True
    command = autopilot._command

    def never_down(message):
        if message.command == dialect.MAV_CMD_NAV_LAND:
            autopilot._ack(message.command, dialect.MAV_RESULT_DENIED)
        else:
            command(message)

    autopilot._command = never_down
    _, url = autopilot_on_udp(autopilot)
    result = load_run(fly_short(link=url, land=True).path).result
    assert (result["outcome"], result["reason"][:31]) == (
        "failsafe", "autopilot refused mode OFFBOARD",
    )  # fmt: skip
    assert result["events"][-1]["text"] == "autopilot refused landing: denied"


def test_garbage_on_the_link_does_not_disturb_the_flight(autopilot_on_udp, fly_short):
    link, url = autopilot_on_udp(FakePX4())
    rng = np.random.default_rng(1)
    link.noise = lambda: rng.bytes(int(rng.integers(1, 300)))
    result = load_run(fly_short(link=url, time_limit_s=2.0).path).result
    assert result["outcome"] == "timeout"


def test_the_link_opens_only_when_everything_is_loaded(
    fly_short, free_port, soon_given_up, monkeypatch
):
    """Seconds of old messages, then a gap where the buffer was full, looked like a lost link."""
    loaded = []

    def warm_up():
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", free_port))
        loaded.append(True)

    monkeypatch.setattr(warm, "warm_up", warm_up)
    with pytest.raises(NoAutopilot):
        fly_short(link=f"udpin:127.0.0.1:{free_port}")
    assert loaded == [True]
