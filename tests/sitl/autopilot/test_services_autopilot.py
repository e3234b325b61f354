import struct

import pytest

from mavfi_cli.link.codec import dialect as d


def answer(bench, message, kind):
    bench.send(message)
    bench.tick()
    return bench.take(kind)


def test_there_are_no_mission_items(bench):
    for mission_type in (0, 1, 2):
        request = d.MAVLink_mission_request_list_message(1, 1, mission_type)
        (count,) = answer(bench, request, "MISSION_COUNT")
        assert (count.count, count.mission_type) == (0, mission_type)
        assert (count.target_system, count.target_component) == (245, 190)


@pytest.mark.parametrize(
    ("message", "result"),
    [
        (d.MAVLink_mission_count_message(1, 1, 3, 0), 3),
        (d.MAVLink_mission_count_message(1, 1, 0, 0), 0),
        (d.MAVLink_mission_clear_all_message(1, 1, 0), 0),
        (d.MAVLink_mission_request_int_message(1, 1, 0, 0), 13),
    ],
)
def test_mission_requests_are_answered(bench, message, result):
    (ack,) = answer(bench, message, "MISSION_ACK")
    assert ack.type == result


def test_file_transfer_gets_a_nak_with_file_not_found(bench):
    path = b"@PARAM/param.pck"
    payload = struct.pack("<HBBBBBxI", 7, 0, 4, len(path), 0, 0, 0) + path
    request = d.MAVLink_file_transfer_protocol_message(0, 1, 1, payload.ljust(251, b"\0"))
    (reply,) = answer(bench, request, "FILE_TRANSFER_PROTOCOL")
    sequence, _, opcode, size, requested = struct.unpack_from("<HBBBB", bytes(reply.payload))
    assert (sequence, opcode, size, requested) == (8, 129, 1, 4)
    assert reply.payload[12] == 10
    assert (reply.target_system, reply.target_component) == (245, 190)


def test_timesync_request_is_answered_with_the_boot_clock(bench):
    bench.run(1.0)
    (reply,) = answer(bench, d.MAVLink_timesync_message(0, 123456789), "TIMESYNC")
    assert (reply.tc1, reply.ts1) == (10**9, 123456789)
    assert answer(bench, d.MAVLink_timesync_message(5, 6), "TIMESYNC") == []


def test_ping_to_everybody_is_echoed(bench):
    (reply,) = answer(bench, d.MAVLink_ping_message(99, 3, 0, 0), "PING")
    assert (reply.time_usec, reply.seq) == (99, 3)
    assert (reply.target_system, reply.target_component) == (245, 190)
    assert answer(bench, d.MAVLink_ping_message(99, 3, 1, 1), "PING") == []


def test_there_are_no_logs(bench):
    (entry,) = answer(bench, d.MAVLink_log_request_list_message(1, 1, 0, 0xFFFF), "LOG_ENTRY")
    assert entry.num_logs == 0


def test_data_stream_requests_change_nothing(bench):
    before = len(bench.received)
    bench.send(d.MAVLink_request_data_stream_message(1, 1, 0, 50, 1))
    bench.run(1.0)
    kinds = {m.get_type() for m in bench.received[before:]}
    assert kinds <= {
        "LOCAL_POSITION_NED", "ATTITUDE_QUATERNION", "HEARTBEAT", "SYS_STATUS",
        "EXTENDED_SYS_STATE", "BATTERY_STATUS",
    }  # fmt: skip
