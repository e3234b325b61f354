"""What the workers of test_fork_server do: the task says what becomes of it."""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from mavfi_cli.core.errors import WorldError


def _refuse(path):
    raise FileNotFoundError(path)


def prepare():
    if os.environ.get("MAVFI_TEST_UNPREPARED"):
        sys.exit("no")
    if os.environ.get("MAVFI_TEST_CHILDLESS"):  # as a kernel without CONFIG_PROC_CHILDREN
        Path.read_text = _refuse


def perform(task, folder):
    left = folder / "left"
    left.mkdir()
    (left / "scratch").write_text(tempfile.gettempdir())
    os.write(2, b"words\n")
    if "sleep_s" in task:
        time.sleep(task["sleep_s"])
    if "orphan" in task:  # a child in a session of its own, that outlives its parent
        line = [sys.executable, "-c", "import signal; signal.pause()"]
        child = subprocess.Popen(line, start_new_session=True)
        (left / "orphan").write_text(str(child.pid))
    if "error" in task:
        raise WorldError(task["error"])
    if "defect" in task:
        raise ZeroDivisionError
    if "signal" in task:
        os.kill(os.getpid(), task["signal"])
    return left
