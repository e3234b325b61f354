"""Whatever ends `mavfi kernels`, no process and no folder of it stays."""

import contextlib
import os
import signal
import subprocess
import time
from pathlib import Path

import pytest
from live_processes import LONG_S, children, gone

from mavfi_cli.attack.callgrind import find_valgrind
from mavfi_cli.core.processes import PYTHON


def descendants(pid):
    """Process ids of children, their children, and so on, with the command lines."""
    found = {}
    with contextlib.suppress(OSError):  # it has ended since
        for child in children(pid):
            found[child] = Path(f"/proc/{child}/cmdline").read_text().replace("\0", " ")
            found |= descendants(child)
    return found


@pytest.fixture
def begun(native_program, tmp_path):
    """Start `mavfi kernels` on a program; wait until it has a descendant of a kind."""
    scratch, out = tmp_path / "tmp", tmp_path / "out"
    scratch.mkdir()
    environment = {**os.environ, "TMPDIR": str(scratch)}
    processes = []

    def begin(count, jobs, has_come):
        line = ["--program", str(native_program("counting")), "--args", str(count)]
        line += ["--runs", "4000", "--jobs", str(jobs), "--out", str(out)]
        process = subprocess.Popen(
            [*PYTHON, "-m", "mavfi_cli", "kernels", *line], env=environment,
            stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL, start_new_session=True,
        )  # fmt: skip
        processes.append(process)
        late_s = time.monotonic() + LONG_S
        while not has_come(found := descendants(process.pid), out):
            assert process.poll() is None
            assert time.monotonic() < late_s
            time.sleep(0.01)
        return process, found, scratch

    yield begin
    for process in processes:
        process.kill()
        process.wait()


def counts(found, _):
    return any("callgrind" in line for line in found.values())


counting = pytest.mark.skipif(find_valgrind() is None, reason="valgrind is missing")


def works(_, out):
    runs = out / "runs.jsonl"
    return runs.is_file() and runs.stat().st_size > 0


@pytest.mark.parametrize(
    ("number", "count", "jobs", "has_come"),
    [
        pytest.param(signal.SIGKILL, 20_000_000, 1, counts, marks=counting),
        pytest.param(signal.SIGTERM, 20_000_000, 1, counts, marks=[counting, pytest.mark.slow]),
        pytest.param(signal.SIGKILL, 30, 2, works, marks=pytest.mark.slow),
        pytest.param(signal.SIGTERM, 30, 2, works, marks=pytest.mark.slow),
        pytest.param(signal.SIGTERM, 30, 1, works, marks=pytest.mark.slow),
    ],
)
def test_nothing_stays(begun, number, count, jobs, has_come):
    process, found, scratch = begun(count, jobs, has_come)
    assert list(scratch.glob("mavfi-kernels-*"))
    process.send_signal(number)
    code = process.wait(LONG_S)
    assert all(gone(pid) for pid in found)
    if number == signal.SIGTERM:
        assert code == 128 + number
        assert not list(scratch.glob("mavfi-*"))
    else:
        assert code == -number
