"""Range finders of the camera component: their geometry, and who gets their messages."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from mavfi_cli.core.frames import quaternion_from_euler
from mavfi_cli.link.codec import Codec, dialect
from mavfi_cli.link.transport import memory_pair
from sitl.autopilot.autopilot import COMPONENT
from sitl.autopilot.telemetry import Preset
from sitl.camera.component import COMPONENT_ID, Camera
from sitl.camera.ranges import SENSORS
from sitl.server import Client
from sitl.simulation import Simulation
from sitl.vehicle.profile import load_profile
from sitl.world import load_world

NOTHING = 2501
RING, BEAM = dialect.MAVLINK_MSG_ID_OBSTACLE_DISTANCE, dialect.MAVLINK_MSG_ID_DISTANCE_SENSOR
WALL = np.array([[5.0, -20.0, 0.0, 6.0, 20.0, 9.0]])  # east of the origin
HERE = np.array([0.0, 0.0, 4.0])


def obstacle_distances(boxes: Any, position: Any, yaw_rad: float) -> list[int]:
    (message,) = SENSORS[RING](boxes, 0.0, position, quaternion_from_euler(0.0, 0.0, yaw_rad))
    return list(message.distances)


def request(number: float, interval_us: float, component: int = COMPONENT_ID) -> Any:
    message = dialect.MAVLink_command_long_message(
        1, component, dialect.MAV_CMD_SET_MESSAGE_INTERVAL, 0, number, interval_us, 0, 0, 0, 0, 0
    )
    codec = Codec(255, 190)
    return codec.decode(codec.encode(message))[0]


def fly(camera: Camera, yaw_rad: float = 0.0, ticks: int = 50) -> list[Any]:
    attitude = quaternion_from_euler(0.1, -0.2, yaw_rad)
    due = [message for k in range(ticks) for message in camera.poll(k * 0.02, HERE, attitude)]
    return [message for message in due if message.get_type() != "HEARTBEAT"]


@pytest.mark.parametrize("yaw_deg", [0, 5, 90, 135, -90, 180])
def test_sectors_are_clockwise_from_the_nose(yaw_deg: int) -> None:
    ranges = obstacle_distances(WALL, HERE, math.radians(yaw_deg))
    for sector, range_cm in enumerate(ranges):
        bearing_deg = yaw_deg - 5.0 * sector  # in the world, counter-clockwise from east
        near = [math.cos(math.radians(bearing_deg + off)) for off in (-2.5, 0.0, 2.5)]
        expected_cm = 500.0 / max(near) if max(near) > 0.21 else math.inf
        if expected_cm > 2500.0 or abs(math.sin(math.radians(bearing_deg))) * 5 > 20 * max(near):
            continue  # beside the wall, or out of range
        assert range_cm == pytest.approx(expected_cm, rel=0.05)
    behind = round(yaw_deg / 5 + 36) % 72
    assert ranges[behind] == NOTHING


def test_a_ring_above_the_wall_sees_nothing() -> None:
    assert set(obstacle_distances(WALL, np.array([0.0, 0.0, 9.5]), 0.0)) == {NOTHING}


def test_the_ring_comes_at_its_interval_and_keeps_level() -> None:
    camera = Camera(WALL)
    assert camera.handle(request(RING, 200_000.0))[0].result == dialect.MAV_RESULT_ACCEPTED
    messages = fly(camera)
    assert [message.get_type() for message in messages] == ["OBSTACLE_DISTANCE"] * 5
    message = Codec(0, 0).decode(Codec(1, COMPONENT_ID).encode(messages[1]))[0]
    assert (message.time_usec, message.increment, message.frame) == (200_000, 5, 12)
    assert (message.min_distance, message.max_distance) == (10, 2500)
    assert list(message.distances) == obstacle_distances(WALL, HERE, 0.0)


def test_beams_look_forward_and_down() -> None:
    camera = Camera(WALL, mount_offset_flu_m=(0.0, 0.0, 0.0))
    camera.handle(request(BEAM, 0.0))  # 10 Hz
    messages = fly(camera)
    assert len(messages) == 20
    ahead, down = messages[:2]
    assert (ahead.id, ahead.orientation, ahead.current_distance) == (0, 0, 500)
    assert (down.id, down.orientation, down.current_distance) == (1, 25, 400)
    camera = Camera(WALL)
    camera.handle(request(BEAM, 0.0))
    west, _ = fly(camera, yaw_rad=math.pi)[:2]
    assert west.current_distance == NOTHING


@pytest.mark.parametrize(
    ("number", "interval_us"),
    [
        (33.0, 0.0),
        (math.nan, 0.0),
        (RING, math.nan),
        (RING, -2.0),
        (1e30, 1.0),
        (BEAM, -math.inf),
        (BEAM, math.inf),
    ],
)
def test_other_messages_and_intervals_are_refused(number: float, interval_us: float) -> None:
    camera = Camera(WALL)
    assert camera.handle(request(number, interval_us))[0].result == dialect.MAV_RESULT_DENIED
    assert camera.handle(request(number, interval_us, component=0)) == []
    assert fly(camera) == []


def test_a_request_ends() -> None:
    camera = Camera(WALL)
    camera.handle(request(RING, 1.0))
    assert len(fly(camera)) == 50  # at most one each tick
    camera.handle(request(RING, -1.0))
    assert fly(camera) == []


def test_only_the_client_that_requested_ranges_gets_them() -> None:
    simulation = Simulation(load_world("farm", seed=3), load_profile("solo"), logs=False)
    links = [memory_pair("memory") for _ in range(2)]
    clients = [Client(simulation, end, preset=Preset.ONBOARD) for _, end in links]
    clients[0].take(Codec(255, 190).encode(request(RING, 100_000.0)))
    kinds: list[list[str]] = [[], []]
    for _ in range(25):
        simulation.advance()
        for number, client in enumerate(clients):
            client.send_tick()
            received = Codec(0, 0).decode(links[number][0].receive(0.0))
            kinds[number] += [message.get_type() for message in received]
    assert [received.count("OBSTACLE_DISTANCE") for received in kinds] == [5, 0]
    clients[0].take(Codec(255, 190).encode(request(RING, -1.0)))
    clients[1].take(Codec(255, 190).encode(request(RING, 0.0)))
    simulation.advance()
    for client in clients:
        client.send_tick()
    last = [[m.get_type() for m in Codec(0, 0).decode(link.receive(0.0))] for link, _ in links]
    assert [received.count("OBSTACLE_DISTANCE") for received in last] == [0, 1]


@pytest.mark.parametrize(
    ("interval_us", "result", "rings"),
    [(100_000.0, dialect.MAV_RESULT_ACCEPTED, 5), (math.nan, dialect.MAV_RESULT_DENIED, 0)],
)
def test_the_autopilot_answers_a_request_for_ranges(
    interval_us: float, result: int, rings: int
) -> None:
    simulation = Simulation(load_world("farm", seed=3), load_profile("solo"), logs=False)
    ours, end = memory_pair("memory")
    client = Client(simulation, end, preset=Preset.ONBOARD)
    client.take(Codec(255, 190).encode(request(RING, interval_us, component=COMPONENT)))
    received = []
    for _ in range(25):
        simulation.advance()
        client.send_tick()
        received += Codec(0, 0).decode(ours.receive(0.0))
    acks = [message for message in received if message.get_type() == "COMMAND_ACK"]
    assert [(ack.get_srcComponent(), ack.result) for ack in acks] == [(COMPONENT, result)]
    kinds = [message.get_type() for message in received]
    assert kinds.count("OBSTACLE_DISTANCE") == rings
