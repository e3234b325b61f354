"""Lockstep: one companion, and no simulated time passes while it thinks.

Each control tick everything due goes out in one send that ends with LOCAL_POSITION_NED. The
next tick begins when the companion has sent SET_POSITION_TARGET_LOCAL_NED with the same
time_boot_ms.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from mavfi_cli.core.errors import LinkLost, VehicleProcessError
from mavfi_cli.link.codec import dialect
from sitl.autopilot.streams import TICK_US
from sitl.server.client import Client
from sitl.server.pace import Pace
from sitl.server.simulation import Simulation

_SETPOINT = dialect.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED
_LOOK_UP_S = 0.2  # how often a silent wait looks whether it should stop


def run_lockstep(
    simulation: Simulation,
    client: Client,
    *,
    speed: float | None,
    limit_s: float,
    stopped: Callable[[], bool],
) -> None:
    """Run until the companion closes the connection, or until stopped.

    Args:
        simulation: the vehicle.
        client: the companion.
        speed: at most so many times real time; None for as fast as the machine goes.
        limit_s: how long the companion may think about one tick, wall clock.
        stopped: whether the user asked to end.

    Raises:
        VehicleProcessError: no answer within the limit.
    """
    pace = None if speed is None else Pace(speed)
    try:
        while not stopped():
            client.send_tick()
            if not _await_answer(simulation.stamp_us // 1000, client, limit_s, stopped):
                return
            if pace is not None:
                pace.next_tick(TICK_US * 1e-6)
                time.sleep(max(pace.remaining_s(), 0.0))
            simulation.advance()
    except LinkLost:
        return


def _await_answer(
    stamp_ms: int, client: Client, limit_s: float, stopped: Callable[[], bool]
) -> bool:
    """Handle what the companion sends until it has answered; False when stopped before."""
    deadline_s = 0.0
    while True:
        messages = client.receive(_LOOK_UP_S)
        for message in reversed(messages):
            if message.get_msgId() == _SETPOINT and message.time_boot_ms == stamp_ms:
                return True
        if messages:
            deadline_s = 0.0
            continue
        now_s = time.monotonic()
        if stopped():
            return False
        if not deadline_s:
            deadline_s = now_s + limit_s
        elif now_s > deadline_s:
            raise VehicleProcessError(
                f"the companion gave no answer to {stamp_ms} ms within {limit_s:g} s"
            )
