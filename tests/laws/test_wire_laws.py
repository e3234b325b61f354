"""Whatever a frame says, nothing raises, and everything that is believed has bounds.

The frames have right checksums: NaN, infinities, extremes and zeros in all fields, payloads that
are cut or too long, and both versions of MAVLink. They are of every message that the companion, the
gate, the simulated vehicle or the stand-alone camera handles.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Collection
from functools import cache
from typing import Any

import numpy as np
import pytest
from fake_autopilot import FakePX4
from hypothesis import given, settings
from hypothesis import strategies as st

from mavfi_cli.companion.injection import NoInjection
from mavfi_cli.companion.pipeline import CompanionParts
from mavfi_cli.core.types import Outcome
from mavfi_cli.link import session, telemetry
from mavfi_cli.link.codec import Codec, dialect, frame_of
from mavfi_cli.link.images import IMAGE_MESSAGES
from mavfi_cli.link.router import Side
from mavfi_cli.link.session import Phase
from mavfi_cli.link.transport import memory_pair
from mavfi_cli.mission.flight import Flight
from mavfi_cli.mission.progress import Watcher
from mavfi_cli.mission.setpoint_gate import SetpointGate
from mavfi_cli.mission.setpoints import SETPOINTS
from mavfi_cli.spec.companion import GateConfig
from mavfi_cli.spec.detector import DetectorConfig
from mavfi_cli.spec.mission import MissionConfig
from sitl.autopilot import services
from sitl.autopilot.telemetry import Preset
from sitl.camera.component import COMPONENT_ID, Camera
from sitl.camera.station import PoseTracker, Station, Witness
from sitl.server import Client
from sitl.simulation import Simulation
from sitl.vehicle.profile import load_profile
from sitl.world import load_world

COMMANDS = {dialect.MAVLINK_MSG_ID_COMMAND_LONG, dialect.MAVLINK_MSG_ID_COMMAND_INT}
BY_COMPANION = {*telemetry._HANDLERS, *session._HANDLED, *IMAGE_MESSAGES}
BY_VEHICLE = {*services.ADDRESSED, *services.ANY_TARGET, dialect.MAVLINK_MSG_ID_STATUSTEXT}
BY_CAMERA = COMMANDS | {
    dialect.MAVLINK_MSG_ID_HEARTBEAT,
    dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
    dialect.MAVLINK_MSG_ID_ATTITUDE,
    dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION,
    dialect.MAVLINK_MSG_ID_EXTENDED_SYS_STATE,
    dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED_SYSTEM_GLOBAL_OFFSET,
}

# Frames -------------------------------------------------------------------------------------------

LARGEST = 3.4028234663852886e38
FLOATS = (0.0, -0.0, 1.0, -1.0, math.nan, math.inf, -math.inf, LARGEST, -LARGEST, 1e-45, 1e6, 9e3)
KNOWN = {"command": sorted({*services._COMMANDS, 2000, 2001, 521, 530, 528}), "target_system": [1],
         "target_component": [1, 100], "target": [1]}  # fmt: skip
TEXTS = [
    b"depth8:crc32=00000000",
    b"MPC_XY_VEL_MAX",
    b"_HASH_CHECK",
    b"\xff\xfe\x1b[2J\0x",
    b"Collisio",
]
TEXTS = [text.ljust(8, b"n") for text in TEXTS]


def scalars(code: str, name: str = "") -> st.SearchStrategy[Any]:
    if code in "fd":
        return st.sampled_from(FLOATS) | st.floats(width=32 if code == "f" else 64)
    bits = 8 * struct.calcsize(f"<{code}")
    low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if code.islower() else (0, (1 << bits) - 1)
    few = [n for n in (low, -1, 0, 1, 2, 6, 100, high) if low <= n <= high]
    return st.sampled_from([*few, *KNOWN.get(name, [])]) | st.integers(low, high)


def fields(code: str, name: str, array: int) -> st.SearchStrategy[Any]:
    if code == "c":
        return st.sampled_from(TEXTS).map(lambda text: text[:array]) | st.binary(max_size=array)
    if not array:
        return scalars(code, name)
    return scalars(code).map(lambda value: [value] * array)


@st.composite
def frames(
    draw: st.DrawFn, numbers: Collection[int], senders: Collection[tuple[int, int]]
) -> bytes:
    """A frame of one of the messages, of one of the senders."""
    cls = dialect.mavlink_map[draw(st.sampled_from(sorted(numbers)))]
    codes = dict(zip(cls.ordered_fieldnames, cls.native_format.decode()[1:], strict=True))
    arrays = dict(zip(cls.ordered_fieldnames, cls.array_lengths, strict=True))
    message = cls(*(draw(fields(codes[name], name, arrays[name])) for name in cls.fieldnames))
    frame = Codec(*draw(st.sampled_from(sorted(senders)))).encode(message)
    if not draw(st.booleans()):
        return frame
    length = draw(st.integers(0, 255))
    payload = frame[10:-2].ljust(255, draw(st.sampled_from([b"\0", b"\xff"])))[:length]
    checked = bytes([length]) + frame[2:10] + payload
    if cls.id < 256 and draw(st.booleans()):  # MAVLink 1
        checked = bytes([length, *frame[4:7], cls.id]) + payload
    marker = b"\xfd" if len(checked) == length + 9 else b"\xfe"
    crc = dialect.x25crc(checked + bytes([cls.crc_extra])).crc
    return marker + checked + crc.to_bytes(2, "little")


def test_the_frames_are_those_of_messages() -> None:
    """Else the laws would hold for frames that every codec drops."""

    @settings(max_examples=200, database=None)
    @given(frames(BY_COMPANION | BY_VEHICLE | BY_CAMERA, [(7, 9)]))
    def arrives(frame: bytes) -> None:
        (message,) = Codec(1, 1).decode(frame)
        assert (message.get_srcSystem(), message.get_srcComponent()) == (7, 9)

    arrives()


# The companion ------------------------------------------------------------------------------------

AUTOPILOT, CAMERA = (1, 1), (1, COMPONENT_ID)
OTHERS = [(1, 101), (1, 190), (1, 0), (7, 1), (7, COMPONENT_ID), (0, 1), (0, 100), (255, 190)]
WALL = np.array([[8.0, -4.0, 0.0, 9.0, 3.0, 12.0]])


class InTheAir(FakePX4):
    """It has taken off already, so that a flight begins at once."""

    def __init__(self) -> None:
        super().__init__(ready_s=0.0)
        self.armed, self.landed, self.position_enu_m = True, 2, [0.0, 0.0, 5.0]


class FlightInMemory:
    """A flight with a scripted autopilot and our depth camera, and with an enemy's frames.

    The link is one stream, so the frames come from the autopilot's own address.
    """

    def __init__(self, *, flies: bool) -> None:
        ours, self._end = memory_pair("udpin:127.0.0.1:1")
        ours.on_wait = self._turn_of_the_others
        config = MissionConfig(
            link="udpin:127.0.0.1:1", goal=(20.0, 0.0, 5.0), stack="hardened", time_limit_s=600.0
        )
        self.autopilot, self.camera = InTheAir(), Camera(WALL)
        self.hostile: list[bytes] = []
        self._decoder = Codec(255, 255)
        self._codecs = Codec(*AUTOPILOT), Codec(*CAMERA)
        self.flight = Flight(config, CompanionParts.of(config), ours, Watcher(), [], NoInjection())
        self.flight.connect()
        if flies:
            self.flight.brief(config.briefing(self.flight.place_enu_m), None)
        self.run(100, until=Phase.OFFBOARD)

    def _turn_of_the_others(self) -> None:
        heard = self._decoder.decode(self._end.receive(0.0))
        of_autopilot = self.autopilot.advance(heard)
        place = np.array(self.autopilot.position_enu_m)
        of_camera = [answer for message in heard for answer in self.camera.handle(message)]
        of_camera += self.camera.poll(self.autopilot.stamp_s, place, np.array([1.0, 0, 0, 0]))
        told = zip(self._codecs, (of_autopilot, of_camera), strict=True)
        data = [codec.encode(message) for codec, messages in told for message in messages]
        self._end.send(b"".join(data + self.hostile))
        self.hostile = []

    def run(self, turns: int, until: Phase | None = None) -> None:
        """Turn until the flight has an outcome, or is in a phase."""
        for _ in range(turns):
            if self.flight.outcome is not None or self.flight._session.phase is until:
                break
            self.flight._turn()
            self.flight._judge()
        assert until in (None, self.flight._session.phase)

    def check(self, *ends: Outcome) -> None:
        """What the companion believes has bounds; the flight ends as a failsafe or as given."""
        heard, hfov_rad = self.flight._session.telemetry, self.flight.images.hfov_rad
        assert self.flight.outcome in (None, Outcome.FAILSAFE, *ends), self.flight.reason
        assert heard.state is not None
        assert np.abs(heard.state.position_enu_m).max() <= 1e4
        assert np.abs(heard.state.velocity_enu_mps).max() <= 1e3
        assert np.linalg.norm(heard.state.quaternion) == pytest.approx(1.0)
        assert abs(heard.state.yaw_rad) <= math.pi
        assert hfov_rad is None or 0.001 < hfov_rad < 3.14
        assert len(self.flight.logger.events) < 1100
        assert all(text.text.isprintable() for text in heard.texts.texts)


SPOOFED = frames(BY_COMPANION, [AUTOPILOT, CAMERA])


@settings(max_examples=40, deadline=None)
@given(st.lists(SPOOFED, min_size=1, max_size=25))
def test_what_a_companion_believes_has_bounds(hostile: list[bytes]) -> None:
    scene = FlightInMemory(flies=False)
    for frame in hostile:
        scene.hostile = [frame]
        scene.run(1)
        scene.check()


def fly_on(hostile: list[bytes], turns: int) -> FlightInMemory:
    scene = FlightInMemory(flies=True)
    for turn in range(turns):
        if turn % 4 == 0:
            scene.hostile = [hostile[turn // 4 % len(hostile)]]
        scene.run(1)
        scene.check()
    return scene


@settings(max_examples=4, deadline=None)
@given(st.lists(SPOOFED, min_size=1, max_size=30))
def test_no_spoofed_frame_ends_a_flying_companion_otherwise_than_by_failsafe(
    hostile: list[bytes],
) -> None:
    fly_on(hostile, turns=150)


PLACES = st.sampled_from(FLOATS) | st.floats(-300.0, 300.0, width=32)


@settings(max_examples=4, deadline=None)
@given(st.lists(st.tuples(st.integers(1, 30), *[PLACES] * 6), min_size=1, max_size=30))
def test_a_companion_flies_on_with_states_that_are_newer_than_the_true_ones(
    states: list[Any],
) -> None:
    """The companion believes them, and looks for the goal from wherever they are."""
    scene, codec = FlightInMemory(flies=True), Codec(*AUTOPILOT)
    for turn in range(150):
        ahead_ms, *state = states[turn // 3 % len(states)]
        stamp_ms = round(scene.autopilot.stamp_s * 1e3) + ahead_ms
        place = dialect.MAVLink_local_position_ned_message(stamp_ms, *state)
        scene.hostile = [codec.encode(place)] if turn % 3 == 0 else []
        scene.run(1)
        scene.check(Outcome.SUCCESS, Outcome.NO_PATH)


@cache
def undisturbed(turns: int) -> Any:
    return fly_on([b""], turns).flight.trace.table(None)


@settings(max_examples=4, deadline=None)
@given(st.lists(frames(BY_COMPANION, OTHERS), min_size=1, max_size=60))
def test_a_companion_does_not_hear_other_systems_and_components(hostile: list[bytes]) -> None:
    """The flight is the same as without them, to the last bit."""
    flight = fly_on(hostile, turns=200).flight
    assert flight.trace.table(None).equals(undisturbed(200))
    assert len(flight.trace) > 100
    assert flight.images.received > 30


def information(focal_mm: float, sensor_mm: float) -> Any:
    """CAMERA_INFORMATION with a field of view."""
    name = [0] * 32
    return dialect.MAVLink_camera_information_message(
        0, name, name, 1, focal_mm, sensor_mm, 3.0, 64, 48, 0, 0, 0, b""
    )


@pytest.mark.parametrize("sender", [CAMERA, (1, 101), (7, COMPONENT_ID)])
@pytest.mark.parametrize("focal_mm", [math.inf, math.nan, 0.0, 1e-45, 30.0])
def test_a_field_of_view_is_that_of_our_camera_and_possible(
    sender: tuple[int, int], focal_mm: float
) -> None:
    """An infinite focal length ended the companion, and a zoom camera narrowed its view."""
    flown = fly_on([Codec(*sender).encode(information(focal_mm, 6.0))], turns=120)
    zoomed = 2.0 * math.atan(0.1) if sender == CAMERA and focal_mm == 30.0 else None
    assert flown.flight.images.hfov_rad == (zoomed and pytest.approx(zoomed))
    assert flown.flight.outcome is None


@pytest.mark.parametrize("stamp_ms", [0, 1, 2**32 - 1])
def test_a_flying_companion_does_not_believe_a_clock_that_leaps_once(stamp_ms: int) -> None:
    leap = dialect.MAVLink_local_position_ned_message(stamp_ms, 0, 0, -5, 0, 0, 0)
    flown = fly_on([Codec(*AUTOPILOT).encode(leap)], turns=120).flight
    assert flown.outcome is None
    assert flown.trace.table(None).equals(undisturbed(120))


def test_a_flood_of_texts_fills_no_record() -> None:
    scene = FlightInMemory(flies=False)
    codec = Codec(*AUTOPILOT)
    for _ in range(30):
        texts = [dialect.MAVLink_statustext_message(6, b"text %d" % n) for n in range(100)]
        scene.hostile = [codec.encode(text) for text in texts]
        scene.run(1)
        scene.check()
    told = [each.text for each in scene.flight.logger.events if each.kind == "autopilot"]
    assert told[-1] == "further texts are not recorded"


# The gate before a user's companion ---------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.tuples(
            frames({*SETPOINTS, dialect.MAVLINK_MSG_ID_HEARTBEAT} | BY_COMPANION, [AUTOPILOT]),
            st.sampled_from(Side),
        ),
        min_size=1,
        max_size=25,
    )
)
def test_a_gate_judges_any_frame_and_passes_only_frames_that_decode(hostile: list[Any]) -> None:
    """It would fail open or closed for good if its detector or its view of the vehicle raised."""
    notes: list[str] = []
    detector, closed = DetectorConfig(name="gad", any_stack=True), GateConfig(on_error="closed")
    gate = SetpointGate(detector, closed, None, note=lambda kind, text: notes.append(text))
    codec = Codec(0, 0, keeps_unknown=True)
    for number, (frame, side) in enumerate(hostile):
        for message in codec.decode(frame):
            passed = [frame_of(own) for own in gate.pass_between(message, side, 0.05 * number)]
            assert all(Codec(0, 0, keeps_unknown=True).decode(own) for own in passed)
            if message.get_msgId() not in SETPOINTS or side is Side.AUTOPILOT:
                assert passed == [frame_of(message)]
    assert not any("gate fails" in note for note in notes)


# The simulated vehicle and its camera -------------------------------------------------------------

CLIENTS = [(245, 190), (255, 230), (1, 191), (1, 1), (0, 0)]


@cache
def vehicle(preset: Preset) -> tuple[Simulation, Client, Any]:
    """A vehicle in flight, which is the same for all examples, and a client's end of its link."""
    simulation = Simulation(load_world("farm", seed=3), load_profile("solo"), logs=False)
    far, end = memory_pair("memory")
    return simulation, Client(simulation, end, preset=preset), far


@pytest.mark.parametrize("preset", list(Preset))
@settings(max_examples=40, deadline=None)
@given(hostile=st.lists(frames(BY_VEHICLE, CLIENTS), min_size=1, max_size=25))
def test_a_vehicle_takes_any_frame_and_says_only_what_can_be_encoded(
    preset: Preset, hostile: list[bytes]
) -> None:
    simulation, client, far = vehicle(preset)
    for frame in hostile:
        far.send(frame)
        client.receive(0.0)
        client.send_answers()
        simulation.advance()
        client.send_tick()
    Codec(1, 1).decode(far.receive(0.0))
    assert np.isfinite(simulation.vehicle.truth.position_ned_m).all()
    if simulation.autopilot.restart_requested:
        simulation.restart()
        client.rejoin()


# The stand-alone camera ---------------------------------------------------------------------------


WORLD = load_world("dense", seed=1)
BESIDE = [AUTOPILOT, CAMERA, (1, 191), (255, 190), (7, 1)]


@settings(max_examples=100, deadline=None)
@given(st.lists(frames(BY_CAMERA, BESIDE), min_size=1, max_size=25), st.booleans())
def test_a_camera_takes_any_frame_and_says_only_what_can_be_encoded(
    tmp_path_factory: pytest.TempPathFactory, hostile: list[bytes], placed: bool
) -> None:
    witness = Witness(WORLD, load_profile("solo"), logs=True)
    camera, tracker = Camera(WORLD.boxes_enu_m), PoseTracker(np.zeros(3))
    station = Station(camera, tracker, [], witness=witness, origin_given=placed)
    codec, order = Codec(1, 191), (0.0, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0)
    told = [
        (AUTOPILOT, dialect.MAVLink_heartbeat_message(2, 12, 129, 6 << 16, 4, 3)),
        ((1, 191), dialect.MAVLink_command_long_message(1, 100, 2000, 0, *order)),
        (AUTOPILOT, dialect.MAVLink_local_position_ned_message(100, 0, 0, -5, 0, 0, 0)),
        (AUTOPILOT, dialect.MAVLink_attitude_message(100, 0, 0, 0, 0, 0, 0)),
    ]
    honest = [Codec(*sender).encode(message) for sender, message in told]
    for frame in [*honest, *hostile]:
        for message in codec.decode(frame):
            station.take(message)
        station.serve()
    witness.save(tmp_path_factory.getbasetemp() / "truth")
