"""Programs of a companion: outputs, readiness and restarts; nothing outlives the flight."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from live_processes import LONG_S, gone

from mavfi_cli.mission.programs import Programs

PYTHON = sys.executable


@pytest.fixture
def start(tmp_path):
    """A function that starts Python code as a program; all end with the test."""
    programs = Programs(tmp_path)

    def started(code, *arguments, **rules):
        task = {
            "argv": [PYTHON, "-c", code, *map(str, arguments)], "folder": str(tmp_path),
            "environment": {}, "restart": "never", "restart_s": 0.0, "ready_line": None,
        }  # fmt: skip
        return programs.start("program", {**task, **rules})

    started.close = programs.close
    yield started
    programs.close()


def awaited(program, condition):
    """Poll a program until a condition holds."""
    until_s = time.monotonic() + LONG_S
    while not condition():
        assert time.monotonic() < until_s, "it never came"
        assert program.poll(), program.failure()
        time.sleep(0.01)


def test_a_program_has_its_outputs_environment_and_exit_code(start, tmp_path):
    code = "import os, sys; print(os.environ['COLOUR']); print('no', file=sys.stderr); sys.exit(3)"
    program = start(code, environment={"COLOUR": "blue"})
    awaited(program, lambda: program.codes)
    assert (program.codes, program.starts, program.pid) == ([3], 1, None)
    folder = tmp_path / "program"
    assert (folder / "stdout").read_text() == "blue\n"
    assert (folder / "stderr").read_text() == "no\n"
    assert program.last_words() == "no"


@pytest.mark.parametrize(
    ("error", "words"),
    [
        ("junk\nValueError: \x1b[31mno\x07 port" + 300 * "!" + "\n  \n",
         "ValueError: no port".ljust(200, "!")),
        ("", ""),
    ],
)  # fmt: skip
def test_the_last_words_of_a_program_are_one_short_printable_line(start, error, words):
    program = start(f"import sys; sys.stderr.write({error!r})")
    awaited(program, lambda: program.codes)
    assert program.last_words() == words


def test_a_line_tells_readiness_before_the_end(start):
    program = start("import time; print('half'); print('the port is open', flush=True)\n"
                    "time.sleep(600)", ready_line="port is")  # fmt: skip
    awaited(program, lambda: program.ready)
    assert program.codes == []


@pytest.mark.parametrize("environment", [{}, {"PYTHONUNBUFFERED": ""}])
def test_a_python_programs_output_is_not_buffered(start, monkeypatch, environment):
    monkeypatch.delenv("PYTHONUNBUFFERED", raising=False)
    end = "import os; os.kill(os.getpid(), 9)"
    program = start(f"print('ready'); {end}", environment=environment, ready_line="ready")
    awaited(program, lambda: program.codes)
    assert program.ready == (not environment)


@pytest.mark.parametrize(
    ("rule", "code", "starts"), [("on-failure", 0, 1), ("never", 1, 1), ("on-failure", 1, 4)]
)
def test_restarts_follow_the_rule(start, tmp_path, rule, code, starts):
    count = "import os, sys; n = len(os.listdir('.')); open(str(n), 'w'); "
    program = start(f"{count}sys.exit({code} if n < 4 else 0)", restart=rule)
    awaited(program, lambda: len(program.codes) == starts)
    time.sleep(0.2)
    program.poll()
    assert program.starts == starts


def test_a_program_does_not_restart_after_the_flight(start, tmp_path):
    count = "import os, time; n = len(os.listdir('.')); open(str(n), 'w'); time.sleep(600)"
    (tmp_path / "starts").mkdir()
    program = start(count, restart="always", folder=str(tmp_path / "starts"))
    awaited(program, lambda: list((tmp_path / "starts").iterdir()))
    start.close()
    assert len(list((tmp_path / "starts").iterdir())) == 1


def test_a_program_has_the_environment_of_the_user(start, tmp_path, monkeypatch):
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    monkeypatch.setenv(names[0], "7")
    monkeypatch.delenv(names[1], raising=False)
    program = start(f"import os; print([os.environ.get(n) for n in {names}])")
    awaited(program, lambda: program.codes)
    assert (tmp_path / "program" / "stdout").read_text() == "['7', None]\n"


def test_a_flood_of_output_is_kept_up_to_a_limit(start, tmp_path):
    program = start("import sys\nfor _ in range(400): sys.stdout.write('x' * 100_000)")
    awaited(program, lambda: program.codes)
    size = (tmp_path / "program" / "stdout").stat().st_size
    assert (16 << 20) <= size < (16 << 20) + 100
    assert program.codes == [0]


FORKS = """
import os, signal, sys, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
if not os.fork():
    os.setsid()
    if os.fork():
        os._exit(0)
    with open(sys.argv[1], "w") as file:
        file.write(str(os.getpid()))
    os.rename(sys.argv[1], sys.argv[1] + ".done")
    time.sleep(600)
os.wait()
{last}
"""


@pytest.mark.parametrize("last", ["time.sleep(600)", "os.kill(os.getpid(), 9)"])
def test_daemons_and_programs_that_ignore_sigterm_end_with_the_flight(start, tmp_path, last):
    place = tmp_path / "daemon"
    program = start(FORKS.format(last=last), place)
    done = tmp_path / "daemon.done"
    awaited(program, done.exists)
    daemon = int(done.read_text())
    if "kill" in last:
        awaited(program, lambda: program.codes)
        assert program.codes == [-signal.SIGKILL]
    pid = program.pid
    os.kill(daemon, 0)  # it lives on after the program that started it
    start.close()
    assert gone(daemon)
    assert pid is None or gone(pid)


OWNER = """
import sys, time
from pathlib import Path
from mavfi_cli.mission.programs import Programs
task = {"argv": [sys.executable, "-c", "import time; time.sleep(600)"], "folder": ".",
        "environment": {}, "restart": "always", "restart_s": 0.0, "ready_line": None}
programs = Programs(Path(sys.argv[1]))  # whose end would end its server
program = programs.start("program", task)
while program.pid is None:
    assert program.poll(), program.failure()
print(program.pid, flush=True)
time.sleep(600)
"""


def test_no_orphan_after_a_kill_of_the_mission(tmp_path):
    owner = subprocess.Popen(
        [PYTHON, "-c", OWNER, str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    pid = int(owner.stdout.readline())
    os.kill(pid, 0)
    owner.kill()
    owner.wait()
    owner.stdout.close()
    assert gone(pid)


def test_a_program_ends_with_its_worker(start):
    program = start("import time; time.sleep(600)")
    awaited(program, lambda: program.pid is not None)
    pid = program.pid
    worker = int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
    os.kill(worker, signal.SIGKILL)
    assert gone(pid)
    while program.poll():
        time.sleep(0.01)
    assert program.failure() == "its process was killed"


def test_a_program_that_cannot_run_is_named(start):
    program = start("", argv=["/etc/passwd"])
    until_s = time.monotonic() + LONG_S
    while program.poll():
        assert time.monotonic() < until_s
        time.sleep(0.01)
    assert program.failure() == "cannot run /etc/passwd: Permission denied"


def test_signals_reach_the_running_process(start):
    program = start("import time; time.sleep(600)")
    assert not program.signal(signal.SIGKILL) or program.starts
    awaited(program, lambda: program.pid is not None)
    assert program.signal(signal.SIGKILL)
    awaited(program, lambda: program.codes)
    assert program.codes == [-signal.SIGKILL]
    assert not program.signal(signal.SIGKILL)
