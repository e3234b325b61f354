from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavfi_cli.core.errors import CommandRefused, NoAutopilot
from mavfi_cli.link.codec import Codec, Message, dialect
from mavfi_cli.link.session import OffboardSession, Phase, SessionSettings

sys.path.insert(0, str(Path(__file__).parent))
from fake_autopilot import (
    DT_S,
    HOME_AMSL_M,
    FakeArduCopter,
    FakeAutopilot,
    FakePX4,
)

HEIGHT_M = 2.5


class Flight:
    """A session and a fake autopilot, tick by tick."""

    def __init__(self, fake: FakeAutopilot, **settings: float) -> None:
        self.fake = fake
        self.session = OffboardSession(
            SessionSettings(takeoff_height_m=HEIGHT_M, **settings),  # type: ignore[arg-type]
            url="udpin:14540",
        )
        self.phases = [Phase.CONNECTING]
        self._companion = Codec(1, 191)
        self._at_fake = Codec(255, 255)

    def tick(self) -> list[Message]:
        for message in self.fake.advance(self._inbox):
            self.session.handle(message)
        sent = self.session.tick(self.fake.stamp_s)
        self._inbox = [m for s in sent for m in self._at_fake.decode(self._companion.encode(s))]
        if self.session.phase is not self.phases[-1]:
            self.phases.append(self.session.phase)
        return sent

    _inbox: list[Message] = []  # noqa: RUF012  (replaced, never changed)

    def until(self, condition: Callable[[], bool], limit_s: float = 60.0) -> None:
        for _ in range(round(limit_s / DT_S)):
            if condition():
                return
            self.tick()
        pytest.fail(f"never came: phases {self.phases}, failure {self.session.failure}")

    def until_phase(self, phase: Phase) -> None:
        self.until(lambda: self.session.phase is phase)

    def sent(self, command: int) -> list[Message]:
        return [m for m in self.fake.commands if m.command == command]


FAKES = pytest.mark.parametrize("make", [FakePX4, FakeArduCopter])


@FAKES
def test_a_whole_flight(make: type[FakeAutopilot]) -> None:
    flight = Flight(make())
    session, fake = flight.session, flight.fake
    flight.until_phase(Phase.OFFBOARD)
    assert fake.armed
    assert fake.mode == fake.autopilot.offboard_mode == session.telemetry.mode
    assert abs(fake.position_enu_m[2] - HEIGHT_M) <= 0.3
    flight.until(lambda: fake.climb_to_m == 0.0)  # PX4 flies the last centimetres in OFFBOARD
    before = list(fake.position_enu_m)
    session.set_target([1.0, 2.0, 0.5], 0.3)
    for _ in range(100):
        flight.tick()
    moved = np.subtract(fake.position_enu_m, before)
    assert moved == pytest.approx([2.0, 4.0, 1.0], abs=0.1)
    assert session.state is not None
    assert session.state.position_enu_m == pytest.approx(fake.position_enu_m, abs=1e-4)
    session.request_land()
    flight.until_phase(Phase.DONE)
    assert flight.phases == list(Phase)[: list(Phase).index(Phase.FAILED)]
    assert not fake.armed
    assert session.telemetry.landed_state == dialect.MAV_LANDED_STATE_ON_GROUND
    assert session.failure is None
    assert not session.failsafe_text


def test_every_tick_ends_with_the_setpoint_of_its_stamp() -> None:
    flight = Flight(FakePX4())
    ticks = 0
    while flight.session.phase is not Phase.DONE:
        sent = flight.tick()
        ticks += 1
        setpoints = [m for m in sent if m.get_type() == "SET_POSITION_TARGET_LOCAL_NED"]
        assert setpoints == sent[-1:]
        assert setpoints[0].time_boot_ms == round(flight.fake.stamp_s * 1e3)
        assert setpoints[0].coordinate_frame == dialect.MAV_FRAME_LOCAL_NED
        if flight.session.phase is Phase.OFFBOARD:
            flight.session.request_land()
        assert ticks < 3000


def test_arducopter_gets_setpoints_in_offboard_only() -> None:
    flight = Flight(FakeArduCopter())
    flight.until_phase(Phase.OFFBOARD)
    assert [m for m in flight.fake.setpoints if m.target_system == 1] == []
    for _ in range(10):
        assert flight.tick()[-1].get_type() == "SET_POSITION_TARGET_LOCAL_NED"


def test_px4_takes_off_to_an_altitude_above_sea_level() -> None:
    flight = Flight(FakePX4())
    flight.until_phase(Phase.OFFBOARD)
    (takeoff,) = flight.sent(dialect.MAV_CMD_NAV_TAKEOFF)
    assert takeoff.param7 == pytest.approx(HOME_AMSL_M + HEIGHT_M)
    assert math.isnan(takeoff.param5)


def test_arducopter_is_guided_before_it_arms_and_takes_off_above_home() -> None:
    flight = Flight(FakeArduCopter(ready_s=3.0))
    flight.until_phase(Phase.OFFBOARD)
    order = [m.command for m in flight.fake.commands if m.command in (176, 400, 22)]
    assert order == [176, 400, 22]
    assert flight.sent(22)[0].param7 == pytest.approx(HEIGHT_M)
    assert flight.sent(176)[0].param2 == 4.0


@FAKES
def test_lost_commands_are_repeated(make: type[FakeAutopilot]) -> None:
    fake = make()
    fake.deaf_to = {176: 2, 400: 2, 22: 2, 21: 2, 511: 3}
    flight = Flight(fake)
    flight.until_phase(Phase.OFFBOARD)
    arms = flight.sent(400)
    assert [m.confirmation for m in arms] == [0, 1, 2]
    flight.session.request_land()
    flight.until_phase(Phase.DONE)


def test_px4s_first_acknowledgement_of_a_mode_is_not_believed() -> None:
    fake = FakePX4()
    fake.refuse_offboard = True
    flight = Flight(fake)
    flight.until(lambda: len(flight.sent(176)) == 2)
    assert flight.session.phase is Phase.TAKING_OFF
    fake.refuse_offboard = False
    flight.until_phase(Phase.OFFBOARD)


def test_offboard_that_is_never_given_fails_with_the_autopilots_words() -> None:
    fake = FakePX4()
    fake.refuse_offboard = True
    flight = Flight(fake)
    flight.until_phase(Phase.FAILED)
    assert isinstance(flight.session.failure, CommandRefused)
    assert "mode OFFBOARD" in str(flight.session.failure)
    assert "not available" in str(flight.session.failure)
    flight.session.request_land()  # and it comes down all the same
    flight.until_phase(Phase.DONE)


def test_px4_left_in_offboard_by_another_client_is_taken_out_of_it_first() -> None:
    fake = FakePX4()
    fake.mode = "OFFBOARD"
    flight = Flight(fake)
    flight.until_phase(Phase.OFFBOARD)
    assert flight.sent(176)[0].param2 == 4.0


def test_no_autopilot() -> None:
    fake = FakePX4()
    fake.silent = True
    flight = Flight(fake, connect_timeout_s=3.0)
    flight.until_phase(Phase.FAILED)
    assert isinstance(flight.session.failure, NoAutopilot)
    assert re.fullmatch("no autopilot at udpin:14540: .* 3 s", str(flight.session.failure))


def test_a_ground_station_is_no_autopilot() -> None:
    session = OffboardSession(SessionSettings(connect_timeout_s=1.0))
    heartbeats = [
        (255, 190, dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)),
        (255, 1, dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)),
        (1, 100, dialect.MAVLink_heartbeat_message(30, 8, 0, 0, 4, 3)),
    ]
    for system, component, heartbeat in heartbeats:
        for message in Codec(9, 9).decode(Codec(system, component).encode(heartbeat)):
            session.handle(message)
    session.tick(0.0)
    session.tick(1.0)
    assert isinstance(session.failure, NoAutopilot)


def test_refused_arming_carries_the_autopilots_own_words() -> None:
    fake = FakePX4()
    fake.refuse_arming = "Arming denied: Resolve system health failures first\t"
    flight = Flight(fake)
    flight.until_phase(Phase.FAILED)
    assert isinstance(flight.session.failure, CommandRefused)
    words = fake.refuse_arming.strip()
    assert str(flight.session.failure).endswith(f"arming: temporarily rejected ({words})")
    assert len(flight.sent(400)) == 3


def test_an_autopilot_that_never_gets_ready() -> None:
    flight = Flight(FakePX4(ready_s=1e9), ready_timeout_s=5.0)
    flight.until(lambda: flight.fake.stamp_s > 2.0)
    flight.fake.tell("Preflight Fail: No manual control input", severity=4)
    flight.until_phase(Phase.FAILED)
    told = r"arming: no position .* within 5 s \(Preflight Fail: No manual control input\)$"
    assert re.search(told, str(flight.session.failure))


def test_a_command_that_nobody_answers() -> None:
    fake = FakePX4()
    fake.deaf_to = {400: 1000}
    flight = Flight(fake)
    flight.until_phase(Phase.FAILED)
    assert "refused arming: no answer" in str(flight.session.failure)
    assert len(flight.sent(400)) == 4


def test_a_vehicle_that_disarms_on_the_ground_fails_the_take_off() -> None:
    fake = FakePX4()
    fake.deaf_to = {22: 1000}
    flight = Flight(fake)
    flight.until_phase(Phase.TAKING_OFF)
    fake.armed = False
    flight.until_phase(Phase.FAILED)
    assert "disarmed" in str(flight.session.failure)


def test_leaving_offboard_unasked_is_a_failsafe() -> None:
    flight = Flight(FakePX4())
    flight.until_phase(Phase.OFFBOARD)
    assert not flight.session.failsafe_text
    flight.fake.mode = "AUTO.RTL"
    flight.until(lambda: flight.session.failsafe_text, 2.0)
    assert "OFFBOARD for AUTO.RTL" in flight.session.failsafe_text
    flight.fake.mode = "OFFBOARD"  # PX4 returns by itself
    flight.until(lambda: flight.session.telemetry.mode == "OFFBOARD", 2.0)
    assert flight.session.failsafe_text


def test_disarming_in_flight_is_a_failsafe() -> None:
    flight = Flight(FakePX4())
    flight.until_phase(Phase.OFFBOARD)
    flight.fake.armed = False
    flight.until(lambda: flight.session.failsafe_text, 2.0)
    assert flight.session.failsafe_text == "the autopilot disarmed in flight"


def test_landing_on_request_is_no_failsafe() -> None:
    flight = Flight(FakePX4())
    flight.until_phase(Phase.OFFBOARD)
    flight.session.request_land()
    flight.until_phase(Phase.DONE)
    assert not flight.session.failsafe_text


def test_a_vehicle_on_the_ground_that_stays_armed_is_disarmed() -> None:
    fake = FakePX4()
    flight = Flight(fake)
    flight.until_phase(Phase.OFFBOARD)
    flight.session.request_land()
    while fake.armed and flight.session.phase is Phase.LANDING:
        fake.ground_since_s = fake.stamp_s  # never long enough on the ground to do it itself
        flight.tick()
    flight.until_phase(Phase.DONE)
    assert [m.param1 for m in flight.sent(400)] == [1.0, 0.0]


def test_landing_before_arming_ends_at_once() -> None:
    flight = Flight(FakePX4(ready_s=5.0))
    flight.until_phase(Phase.WAITING_READY)
    flight.session.request_land()
    flight.tick()
    assert flight.session.phase is Phase.DONE
    assert flight.sent(21) == []


def test_a_vehicle_already_flying_is_taken_over_without_take_off() -> None:
    fake = FakePX4()
    fake.armed, fake.landed, fake.position_enu_m = True, 2, [3.0, 4.0, 5.0]
    flight = Flight(fake)
    flight.until_phase(Phase.OFFBOARD)
    assert flight.sent(22) == flight.sent(400) == []


def test_heartbeats_go_on_when_the_clock_was_estimated_too_fast() -> None:
    session = OffboardSession()
    stamps_s = [0.0, 0.5, 1.0, 6.0, 2.0, 2.5, 3.0]
    beats = [
        stamp_s
        for stamp_s in stamps_s
        for message in session.tick(stamp_s)
        if message.get_type() == "HEARTBEAT"
    ]
    assert beats == [0.0, 1.0, 6.0, 2.0, 3.0]


def test_a_reported_collision() -> None:
    flight = Flight(FakePX4())
    flight.until_phase(Phase.OFFBOARD)
    words = "Collision: box 17 at east 12.31 north 20.02 up 5.00, clearance 0.00 m"
    flight.fake.tell(words, severity=0)
    flight.tick()
    assert flight.session.telemetry.collision_text == words
    assert flight.session.telemetry.texts.texts[-1].severity == 0


def test_a_text_cannot_write_on_the_terminal() -> None:
    session = _heard()
    session.handle(_from(1, 1, dialect.MAVLink_statustext_message(2, b"a\x1b[2J\nb\xff\t")))
    assert session.telemetry.texts.texts[-1].text == "a\ufffd[2J\ufffdb\ufffd"


def test_the_setpoint_in_ned() -> None:
    session = OffboardSession()
    session.set_target([1.0, 2.0, 3.0], 0.0, [0.1, 0.2, 0.3])
    message = session.tick(1.5)[-1]
    assert (message.vx, message.vy, message.vz) == (2.0, 1.0, -3.0)
    assert (message.afx, message.afy, message.afz) == (0.2, 0.1, -0.3)
    assert message.yaw == pytest.approx(math.pi / 2)
    assert message.time_boot_ms == 1500
    assert message.type_mask == 2055
    session.set_target([1.0, 2.0, 3.0], 0.0)
    assert session.tick(1.52)[-1].type_mask == 2503
    session.hold()
    held = session.tick(1.54)[-1]
    assert (held.vx, held.vy, held.vz, held.type_mask) == (0.0, 0.0, 0.0, 3527)


ANY = st.floats(allow_nan=True, allow_infinity=True)


@given(st.tuples(ANY, ANY, ANY), ANY, st.tuples(ANY, ANY, ANY))
def test_a_corrupted_command_still_goes_out(
    velocity: tuple[float, ...], yaw: float, acceleration: tuple[float, ...]
) -> None:
    session = OffboardSession()
    session.set_target(velocity, yaw, acceleration)
    frames = [Codec(1, 191).encode(message) for message in session.tick(0.0)]
    message = Codec(1, 1).decode(frames[-1])[-1]
    with np.errstate(over="ignore"):
        wanted = np.float32([velocity[1], velocity[0], -velocity[2]])
    sent = np.float32([message.vx, message.vy, message.vz])
    finite = np.isfinite(wanted)
    assert np.array_equal(sent[finite], wanted[finite])
    assert not np.isfinite(sent[~finite]).any()


def _from(system: int, component: int, message: Message) -> Message:
    (decoded,) = Codec(9, 9).decode(Codec(system, component).encode(message))
    return decoded


def _heard() -> OffboardSession:
    session = OffboardSession()
    session.handle(_from(1, 1, dialect.MAVLink_heartbeat_message(2, 12, 1, 0, 3, 3)))
    return session


def test_requests_for_time_and_ping_are_answered() -> None:
    session = _heard()
    session.tick(2.0)
    for stranger in ((1, 190), (7, 1)):
        session.handle(_from(*stranger, dialect.MAVLink_timesync_message(0, 99)))
        session.handle(_from(*stranger, dialect.MAVLink_ping_message(99, 9, 0, 0)))
    session.handle(_from(1, 1, dialect.MAVLink_timesync_message(0, 1234)))
    session.handle(_from(1, 1, dialect.MAVLink_ping_message(55, 6, 0, 0)))
    session.handle(_from(1, 1, dialect.MAVLink_timesync_message(99, 1234)))  # an answer
    session.handle(_from(1, 1, dialect.MAVLink_ping_message(55, 6, 1, 191)))  # an answer
    sync, ping, *_, setpoint = session.tick(2.02)
    assert (sync.tc1, sync.ts1) == (2_000_000_000, 1234)
    assert (ping.time_usec, ping.seq, ping.target_system, ping.target_component) == (55, 6, 1, 1)
    assert setpoint.get_type() == "SET_POSITION_TARGET_LOCAL_NED"


def test_a_flood_of_requests_is_answered_in_bounds() -> None:
    session = _heard()
    request = _from(1, 1, dialect.MAVLink_timesync_message(0, 1))
    for _ in range(10_000):
        session.handle(request)
    assert 50 < len(session.tick(0.0)) < 100


def test_our_own_heartbeat_once_a_second() -> None:
    session = OffboardSession(SessionSettings(connect_timeout_s=100.0))
    beats = [
        (k * DT_S, m)
        for k in range(151)
        for m in session.tick(k * DT_S)
        if m.get_type() == "HEARTBEAT"
    ]
    assert [stamp_s for stamp_s, _ in beats] == pytest.approx([0.0, 1.0, 2.0, 3.0])
    assert beats[0][1].type == dialect.MAV_TYPE_ONBOARD_CONTROLLER
    assert beats[0][1].autopilot == dialect.MAV_AUTOPILOT_INVALID


def test_the_camera_is_asked_who_it_is_and_started() -> None:
    flight = Flight(FakePX4())
    flight.until_phase(Phase.WAITING_READY)
    session = flight.session
    session.handle(_from(1, 100, dialect.MAVLink_heartbeat_message(30, 8, 0, 0, 4, 3)))
    session.start_camera(0.1)
    asked = {
        m.command: m
        for m in flight.tick()
        if m.get_type() == "COMMAND_LONG" and m.target_component == 100
    }
    assert set(asked) == {512, 2000}
    assert asked[512].param1 == 259
    assert asked[2000].param2 == pytest.approx(0.1)
    session.handle(_from(1, 100, dialect.MAVLink_command_ack_message(2000, 0, 0, 0, 1, 191)))
    repeated = [m for _ in range(100) for m in flight.tick() if m.get_type() == "COMMAND_LONG"]
    assert {m.command for m in repeated if m.target_component == 100} == {512}  # unanswered


def test_a_camera_that_does_not_tell_the_origin_is_named() -> None:
    """It answers that it is working on it, as a camera does that waits for an origin."""
    flight = Flight(FakePX4(), needs_camera=True, ready_timeout_s=7.0)

    def refused() -> bool:
        progress = dialect.MAV_RESULT_IN_PROGRESS
        answer = dialect.MAVLink_command_ack_message(512, progress, 0, 0, 1, 191)
        flight.session.handle(_from(1, 100, answer))
        return flight.session.failure is not None

    flight.until(refused, limit_s=10.0)
    assert re.search("arming: no origin .* 7 s", str(flight.session.failure))


def test_states_are_found_again_by_stamp() -> None:
    flight = Flight(FakePX4())
    flight.until_phase(Phase.OFFBOARD)
    flight.session.set_target([1.0, 0.0, 0.0], 0.0)
    for _ in range(50):
        flight.tick()
    session, now_s = flight.session, flight.fake.stamp_s
    assert session.state is not None
    assert session.state_at(now_s) is session.state
    left, right = session.state_at(now_s - 2 * DT_S), session.state_at(now_s - DT_S)
    between = session.state_at(now_s - 1.25 * DT_S)
    assert left is not None
    assert right is not None
    assert between is not None
    mixed = 0.25 * left.position_enu_m + 0.75 * right.position_enu_m
    assert between.position_enu_m == pytest.approx(mixed)
    assert session.state_at(now_s + DT_S) is None
    assert session.state_at(-1.0) is None


NUMBERS = [0, 1, 4, 30, 31, 32, 33, 77, 111, 147, 242, 245, 253, 259, 271]


@settings(max_examples=100, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.sampled_from(NUMBERS), st.sampled_from([1, 100, 255]), st.binary(max_size=255)
        ),
        max_size=20,
    )
)
def test_well_formed_nonsense_never_raises(
    frames: list[tuple[int, int, bytes]],
) -> None:
    """Any payload at all in the messages that the session listens to."""
    flight = Flight(FakePX4(ready_s=0.0))
    for _ in range(60):
        flight.tick()
    for number, component, payload in frames:
        cls = dialect.mavlink_map[number]
        size = cls.unpacker.size
        head = bytes([0xFD, size, 0, 0, 0, 1, component, number & 255, number >> 8, 0])
        body = head + payload[:size].ljust(size, b"\xff")
        crc = dialect.x25crc(body[1:] + bytes([cls.crc_extra])).crc
        (message,) = Codec(9, 9).decode(body + crc.to_bytes(2, "little"))
        flight.session.handle(message)
        for reply in flight.session.tick(flight.fake.stamp_s):
            Codec(1, 191).encode(reply)
    state = flight.session.state
    assert state is None or np.isfinite(state.position_enu_m).all()
