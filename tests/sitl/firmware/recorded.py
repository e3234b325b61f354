"""Bytes that real firmware sent, recorded on its simulator link and its MAVLink link."""

from __future__ import annotations

# PX4 v1.17.0.

# Its first bytes on the simulator link: a request for HIL_STATE_QUATERNION and a heartbeat.
PX4_HELLO = (
    bytes.fromhex("fd1e00000001014c00000000e64200409c45")
    + bytes(20)
    + bytes.fromhex("ff011904fd090000010101")
    + bytes(8)
    + bytes.fromhex("0c0000039158")
)

# HIL_ACTUATOR_CONTROLS by the stamp of the HIL_SENSOR that they answer, us: disarmed, idling, and
# three steps of a climb.
PX4_CONTROLS = {
    10004000: bytes.fromhex("fd5100009d01015d000020a698000000000001")
    + bytes(71)
    + bytes.fromhex("013fb2"),
    11816000: bytes.fromhex(
        "fd5100006201015d0000404cb4000000000001000000000000006310983e8816993e9a99993e3e0a973e"
    )
    + bytes(48)
    + bytes.fromhex("816f30"),
    15000000: bytes.fromhex(
        "fd5100007e01015d0000c0e1e400000000000100000000000000c9761e3f52b81e3f52b81e3fc9761e3f"
    )
    + bytes(48)
    + bytes.fromhex("811bed"),
    15004000: bytes.fromhex(
        "fd5100007f01015d000060f1e400000000000100000000000000c9761e3f52b81e3f52b81e3fc9761e3f"
    )
    + bytes(48)
    + bytes.fromhex("814b17"),
    15008000: bytes.fromhex(
        "fd5100008001015d00000001e50000000000010000000000000052b81e3f52b81e3f52b81e3fc9761e3f"
    )
    + bytes(48)
    + bytes.fromhex("810890"),
}

# On its MAVLink link: a heartbeat in AUTO.TAKEOFF, armed; a position.
PX4_HEARTBEAT = bytes.fromhex("fd090000f7010100000000000402020c9d04034e13")
PX4_POSITION = bytes.fromhex(
    "fd1c00009c0101200000b4360000798f0a3d92d5e8bc007807be4caf573c711daa3aa4f99abdb366"
)

# ArduCopter 4.5: its servo frames on the JSON backend. The first two, before the first state and
# after it, and two that follow each other in a climb.
ARDUPILOT_FIRST = (
    bytes.fromhex("1a48b00400000000") + bytes.fromhex("e803") * 16,
    bytes.fromhex("1a48af0401000000") + bytes.fromhex("e803") * 16,
)
ARDUPILOT_CLIMB = (
    bytes.fromhex("1a489001af4f00002e062f062e062e06") + bytes(24),
    bytes.fromhex("1a489001b04f00002e062f062e062f06") + bytes(24),
)
