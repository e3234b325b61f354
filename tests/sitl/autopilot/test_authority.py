"""Who commands: the trusted systems, and one sender of setpoints at a time."""

import pytest

from mavfi_cli.link.codec import Codec, dialect
from sitl.autopilot.autopilot import Autopilot
from sitl.autopilot.commander import FlightMode
from sitl.autopilot.services import handle


def as_sender(message, system, component=191):
    """The message as it arrives from a sender."""
    (received,) = Codec(1, 1).decode(Codec(system, component).encode(message))
    return received


def command(number, *parameters):
    given = [*parameters, *([0.0] * (7 - len(parameters)))]
    return dialect.MAVLink_command_long_message(1, 1, number, 0, *given)


def test_the_first_of_two_companions_commands_until_it_is_silent(flying, velocity_target):
    autopilot, link = flying.autopilot, flying.link
    flying.send(velocity_target(north=1.0))
    flying.command(176, 1, 6)
    for _ in range(50):
        flying.send(velocity_target(north=1.0))
        handle(autopilot, as_sender(velocity_target(north=-5.0), 7), link)
        flying.tick()
        assert autopilot.snapshot.setpoint[3] == 1.0
    assert flying.texts().count((4, "Setpoints of 7/191 ignored: 245/190 commands")) == 1
    for _ in range(150):  # a second of silence, and a second until the failsafe ends
        handle(autopilot, as_sender(velocity_target(north=2.0), 7), link)
        flying.tick()
    assert autopilot.snapshot.setpoint[3] == 2.0
    assert flying.mode is FlightMode.OFFBOARD
    assert (4, "7/191 commands instead of 245/190") in flying.texts()


def test_only_a_trusted_system_commands(make_bench, velocity_target):
    bench = make_bench()
    bench.autopilot = Autopilot(bench.vehicle, trusted=[7])
    bench.link = bench.autopilot.open_link(bench.link_preset)
    bench.autopilot.observe(0, bench.vehicle)
    bench.run(4.5)
    bench.texts()
    store = bench.autopilot.parameters
    bench.command(400, 1)
    bench.send(dialect.MAVLink_param_set_message(1, 1, b"MPC_XY_VEL_MAX", 3.0, 9))
    bench.send(dialect.MAVLink_set_mode_message(1, 1, 6 << 16))
    bench.send(velocity_target())
    bench.command(512, dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
    assert bench.acks() == [(400, 2), (176, 2), (512, 0)]
    (answer,) = bench.take("PARAM_VALUE")
    assert (answer.param_id, answer.param_value) == ("MPC_XY_VEL_MAX", 12.0)
    assert store.value("MPC_XY_VEL_MAX") == 12.0
    assert not bench.commander.armed
    assert bench.mode is FlightMode.LOITER
    assert not bench.commander.is_available(FlightMode.OFFBOARD)
    assert bench.texts() == [(4, "Commands of system 245 refused, trusted: 7")]
    handle(bench.autopilot, as_sender(command(400, 1.0), 7), bench.link)
    assert bench.commander.armed


def test_a_flood_of_mistakes_is_not_one_of_texts(bench, velocity_target):
    bench.run(1.0)
    bench.texts()
    for _ in range(1000):
        bench.send(velocity_target(coordinate_frame=12))
    bench.tick()
    assert len(bench.texts()) == 10


@pytest.mark.parametrize("number", [0, 2, 3])
def test_a_reboot_is_only_that_of_the_autopilot(make_bench, number):
    from sitl.autopilot.telemetry import Preset

    bench = make_bench(Preset.GCS)
    bench.run(5.0)
    bench.command(246, number)
    assert bench.acks() == [(246, 3)]
    assert not bench.autopilot.restart_requested


def test_a_reboot_needs_a_vehicle_that_is_disarmed_or_lost(make_bench):
    from sitl.autopilot.telemetry import Preset

    bench = make_bench(Preset.GCS)
    bench.command(246, 1)
    assert bench.acks() == [(246, 1)]  # it still boots
    bench.fly()
    bench.command(246, 1)
    assert bench.acks() == [(246, 1)]
    assert (2, "Reboot denied: armed") in bench.texts()
    bench.commander.terminate("Collision: ground")
    bench.command(246, 1)
    assert bench.acks() == [(246, 0)]
    assert bench.autopilot.restart_requested


def test_in_lockstep_there_is_no_reboot(bench):
    bench.run(5.0)
    bench.command(246, 1)
    assert bench.acks() == [(246, 3)]
