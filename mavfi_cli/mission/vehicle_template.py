"""A warm process that forks the simulated vehicles of one mission after the other.

`python -m sitl` needs about as long to import and compile as it flies. The template, whose other
side is `sitl.server.template`, has that behind it; each vehicle is a fork of it that has flown
nothing.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from mavfi_cli.core.errors import VehicleProcessError
from mavfi_cli.core.processes import ONE_THREAD

_FLY, _SETTLE, _SETTLED = b"fly", b"settle", b"settled"
_BRANCH_S = 60.0  # a waiting vehicle takes a few milliseconds
_WORD = 64  # bytes of the longest thing that the template says


class VehicleTemplate:
    """Starts the template, which gets warm by itself; the caller becomes its parent.

    A fork of the caller, which a mission is, may call `start`; the caller itself waits for the end
    of that fork and then calls `settle`.

    Raises:
        VehicleProcessError: it cannot be started.
    """

    def __init__(self) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        line = [sys.executable, "-m", "sitl.server.template", str(theirs.fileno())]
        with theirs:
            try:
                self._process = subprocess.Popen(
                    [*line, str(os.getpid())],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    pass_fds=[theirs.fileno()],
                    env={**os.environ, **ONE_THREAD},
                    start_new_session=True,
                )
            except OSError as error:
                ours.close()
                raise VehicleProcessError(f"cannot start the vehicle: {error}") from None
        self._control = ours

    @property
    def pid(self) -> int:
        """Process id of the template."""
        return self._process.pid

    def start(self, arguments: Sequence[str], link: socket.socket, errors: int) -> ForkedVehicle:
        """Fork a vehicle.

        Args:
            arguments: of `python -m sitl`, without `--fd`.
            link: the vehicle's end of the link; the caller closes its own copy.
            errors: descriptor of the file for what it says on its standard error.

        Raises:
            VehicleProcessError: the template has ended.
        """
        order = {"arguments": list(arguments), "tmp": tempfile.gettempdir()}
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            descriptors = [link.fileno(), errors, theirs.fileno()]
            try:
                socket.send_fds(self._control, [_FLY + json.dumps(order).encode()], descriptors)
            except OSError:
                ours.close()
                raise VehicleProcessError(
                    "cannot start the vehicle: its template is gone"
                ) from None
        return ForkedVehicle(ours)

    def settle(self, timeout_s: float) -> bool:
        """End every vehicle that is left; whether the template has done so, and can go on."""
        self._control.settimeout(timeout_s)
        try:
            self._control.send(_SETTLE)
            return self._control.recv(_WORD) == _SETTLED
        except OSError:
            return False

    def close(self) -> None:
        """End the template and its vehicles."""
        self._control.close()
        self._process.kill()
        self._process.wait()


class ForkedVehicle:
    """One vehicle of a template, in the words of `subprocess.Popen`.

    Args:
        status: channel on which the template says how it ended.
    """

    def __init__(self, status: socket.socket) -> None:
        self._status = status
        self._process: int | None = None  # a descriptor
        self._code: int | None = None

    def wait(self, timeout_s: float | None = None) -> int:
        """The code with which it ended.

        Raises:
            subprocess.TimeoutExpired: it has not ended within `timeout_s`.
        """
        while not self._hear(timeout_s):
            pass
        assert self._code is not None
        return self._code

    def poll(self) -> int | None:
        """The code with which it ended; None while it flies."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            while not self._hear(0.0):
                pass
        return self._code

    def _hear(self, timeout_s: float | None) -> bool:
        """One word of the template; whether the end is known."""
        if self._code is not None:
            return True
        if not select.select([self._status], [], [], timeout_s)[0]:
            raise subprocess.TimeoutExpired("the vehicle", timeout_s or 0.0)
        try:
            said, descriptors, _, _ = socket.recv_fds(self._status, _WORD, 1)
        except OSError:
            said, descriptors = b"", []
        if descriptors:
            self._process = descriptors[0]
            return False
        # Without a word the template is gone, and has taken the vehicle with it.
        self._code = int(said) if said else -signal.SIGKILL
        return True

    def branch(self, truth_folder: Path, link: socket.socket, errors: int) -> ForkedVehicle:
        """The vehicle once more, as it is now, while it waits for an answer.

        Args:
            truth_folder: where the new one leaves its truth.
            link: its end of the link; the caller closes its own copy.
            errors: descriptor of the file for what it says on its standard error.

        Raises:
            VehicleProcessError: it is gone, or does not hear.
        """
        self.poll()
        gone = VehicleProcessError("the vehicle did not branch")
        if self._process is None or self._code is not None:
            raise gone
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        twin = ForkedVehicle(ours)
        order = json.dumps({"truth": str(truth_folder)}).encode()
        try:
            with theirs:
                descriptors = [link.fileno(), errors, theirs.fileno()]
                socket.send_fds(self._status, [order], descriptors)
            signal.pidfd_send_signal(self._process, signal.SIGUSR1)
            if not twin._hear(_BRANCH_S):
                return twin
        except (OSError, subprocess.TimeoutExpired):
            pass
        twin.close()
        raise gone

    def kill(self) -> None:
        """End it at once."""
        self.poll()
        if self._process is not None and self._code is None:
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._process, signal.SIGKILL)

    def close(self) -> None:
        """Release what is held of it."""
        self._status.close()
        if self._process is not None:
            os.close(self._process)
            self._process = None
