"""The process of a firmware's binary, in a folder of its own."""

from __future__ import annotations

import contextlib
import functools
import os
import shutil
import signal
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path

from mavfi_cli.core.errors import VehicleProcessError
from mavfi_cli.core.fork_server import die_with

_OUTPUT = "output.txt"


def require_program(path: Path) -> Path:
    """Return the absolute path of a program.

    Raises:
        VehicleProcessError: It does not exist or must not be executed.
    """
    if not path.is_file():
        raise VehicleProcessError(f"no firmware at {path}")
    if not os.access(path, os.X_OK):
        raise VehicleProcessError(f"no permission to execute {path}")
    return path.resolve()


class FirmwareProcess:
    """A running firmware. Its folder and everything that it started end with it.

    Args:
        binary: The program.
        arguments: Command line after the program.
        folder: Working folder, removed at the end.
        environment: Additions to the environment.

    Raises:
        VehicleProcessError: The program cannot be started.
    """

    def __init__(
        self,
        binary: Path,
        arguments: Sequence[str],
        folder: Path,
        environment: Mapping[str, str],
    ) -> None:
        self._binary, self._folder = binary, folder
        try:
            with (folder / _OUTPUT).open("wb") as output:
                self._process = subprocess.Popen(
                    [str(binary), *arguments],
                    cwd=folder,
                    env={**os.environ, **environment},
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    start_new_session=True,
                    preexec_fn=functools.partial(die_with, os.getpid()),
                )
        except OSError as error:
            self._remove_folder()
            raise VehicleProcessError(f"{binary} is not a firmware: {error.strerror}") from None

    def require_running(self) -> None:
        """Check that it still runs.

        Raises:
            VehicleProcessError: It has ended; quotes its last line.
        """
        code = self._process.poll()
        if code is None:
            return
        lines = (self._folder / _OUTPUT).read_text(errors="replace").split("\n")
        said = [line.strip() for line in lines if line.strip()]
        last = f": {said[-1]}" if said else ""
        how = f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"
        raise VehicleProcessError(f"the firmware {self._binary} {how}{last}")

    def end(self) -> None:
        """Kill it with all of its children and remove its folder. May be called repeatedly."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._remove_folder()

    def _remove_folder(self) -> None:
        shutil.rmtree(self._folder, ignore_errors=True)
