"""Exact stops, clean resumption, every thread, no orphans."""

import os
import select
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from mavfi_cli.core.errors import TargetError
from mavfi_cli.core.processes import Ended
from mavfi_cli.fi.tracer import linux
from mavfi_cli.fi.tracer.image import Image
from mavfi_cli.fi.tracer.inject import clean_step, instruction_at
from mavfi_cli.fi.tracer.linux import ProcessTimer
from mavfi_cli.fi.tracer.spawn import Program, spawn
from mavfi_cli.fi.tracer.tracee import ExecutionCounter, Mechanism, Tracee


def entry(tracee, program, function):
    image = Image(tracee.pid)
    return image.address(image.function(function, [program]))


@pytest.mark.parametrize("mechanism", list(Mechanism))
@pytest.mark.parametrize("k", [1, 2, 37, 100])
def test_the_kth_hit_equals_the_loop_counter(start, tmp_path, mechanism, k):
    tracee = start("counting", "100", mechanism=mechanism)
    body = entry(tracee, "counting", "body")
    assert tracee.run_to(body, k)
    assert tracee.mechanism is mechanism
    assert tracee.registers.ip == body
    assert tracee.registers.read("rdi") == k - 1
    assert tracee.resume() == Ended(exit_code=0, signal=None)
    assert (tmp_path / "stdout").read_text().startswith("99 ")


@pytest.mark.parametrize("mechanism", list(Mechanism))
def test_a_trigger_after_the_last_execution_is_not_reached(start, mechanism):
    tracee = start("counting", "100", mechanism=mechanism)
    assert not tracee.run_to(entry(tracee, "counting", "body"), 101)
    assert tracee.ended == Ended(exit_code=0, signal=None)


def test_two_stages_count_from_the_first(start):
    tracee = start("counting", "100")
    body = entry(tracee, "counting", "body")
    assert tracee.run_to(body, 10)
    second = instruction_at(tracee, body).next_address
    assert tracee.run_to(second, 3)
    assert tracee.registers.read("rdi") == 11
    assert tracee.run_to(body, 1)
    assert tracee.registers.read("rdi") == 12


@pytest.mark.parametrize("mechanism", list(Mechanism))
def test_the_execution_in_front_of_us_counts(start, mechanism):
    tracee = start("counting", "100", mechanism=mechanism)
    body = entry(tracee, "counting", "body")
    assert tracee.run_to(body, 10)
    assert tracee.run_to(body, 1)
    assert tracee.registers.read("rdi") == 9
    assert tracee.run_to(body, 2)
    assert tracee.registers.read("rdi") == 10


def test_a_stop_inside_a_blocking_system_call_resumes_correctly(start, tmp_path):
    tracee = start("sleeper")
    begin = time.monotonic()
    alarm = ProcessTimer(tracee.pid, signal.SIGTRAP, cpu_s=None, wall_s=0.05)
    stopped = tracee.resume_until_alarm(alarm)
    assert stopped is None
    assert tracee.registers.system_call in (35, 230)  # nanosleep, clock_nanosleep
    unused = tracee.registers.read("r15")
    tracee.registers.write("r15", unused ^ 1)
    tracee.registers.write("r15", unused)
    assert tracee.resume() == Ended(exit_code=0, signal=None)
    assert (tmp_path / "stdout").read_text() == "0\n"
    assert time.monotonic() - begin >= 0.15


def test_a_timer_may_kill_a_program_that_is_stopped(start):
    tracee = start("counting")
    with ProcessTimer(tracee.pid, signal.SIGKILL, cpu_s=None, wall_s=0.0) as alarm:
        while True:  # until the first request that finds it dead
            tracee.registers.forget()
            assert tracee.registers.ip
    assert alarm.fired
    assert tracee.resume() == Ended(exit_code=None, signal=signal.SIGKILL)


@pytest.mark.filterwarnings("error")
def test_a_limit_that_is_never_reached_does_not_end_the_timer(start):
    tracee = start("sleeper")
    with ProcessTimer(tracee.pid, signal.SIGKILL, cpu_s=None, wall_s=1e18) as alarm:
        time.sleep(0.05)
        assert alarm._thread.is_alive()


def test_a_limit_of_cpu_time_allows_for_threads_on_every_processor(start, monkeypatch):
    monkeypatch.setattr(linux.os, "cpu_count", lambda: 4)
    tracee = start("counting")  # stopped, so it uses no CPU time
    with ProcessTimer(tracee.pid, signal.SIGKILL, cpu_s=80.0, wall_s=None) as alarm:
        assert alarm._left_s() == pytest.approx(20.0)


def test_an_interrupt_stops_and_resumes(start, tmp_path):
    tracee = start("sleeper")
    for _ in range(5):
        linux.request(linux.CONT, tracee.tid)
        tracee.interrupt()
    assert tracee.resume() == Ended(exit_code=0, signal=None)
    assert (tmp_path / "stdout").read_text() == "0\n"


def test_no_trap_flag_is_left_after_pushf_and_popf(start):
    tracee = start("destinations")
    image = Image(tracee.pid)
    pushf = entry(tracee, "destinations", "parade")
    while instruction_at(tracee, pushf).mnemonic != "pushfq":
        pushf = instruction_at(tracee, pushf).next_address
    assert tracee.run_to(pushf)
    clean_step(tracee, instruction_at(tracee, tracee.registers.ip))
    saved = int.from_bytes(tracee.memory.read(tracee.registers.sp, 8), "little")
    assert not saved & 0x100
    assert instruction_at(tracee, tracee.registers.ip).mnemonic == "popfq"
    clean_step(tracee, instruction_at(tracee, tracee.registers.ip))
    assert image.locate(tracee.registers.ip).object == "destinations"
    assert instruction_at(tracee, tracee.registers.ip).mnemonic == "ret"
    clean_step(tracee, instruction_at(tracee, tracee.registers.ip))
    assert tracee.resume() == Ended(exit_code=0, signal=None)
    assert tracee.signals == []


def test_pushf_under_a_bare_step_shows_why_the_care_is_needed(start):
    tracee = start("destinations")
    pushf = entry(tracee, "destinations", "parade")
    while instruction_at(tracee, pushf).mnemonic != "pushfq":
        pushf = instruction_at(tracee, pushf).next_address
    assert tracee.run_to(pushf)
    tracee.step()
    saved = int.from_bytes(tracee.memory.read(tracee.registers.sp, 8), "little")
    assert saved & 0x100


def test_every_thread_of_the_program_goes_on(start, tmp_path):
    tracee = start("threads")
    assert tracee.run_to(entry(tracee, "threads", "body"), 20)
    assert tracee.registers.read("rdi") == 19
    assert tracee.resume() == Ended(exit_code=0, signal=None)
    assert (tmp_path / "stdout").read_text() == "3019\n"


def test_stepping_through_thread_creation_does_not_deadlock(start, tmp_path):
    tracee = start("threads")
    assert tracee.run_to(entry(tracee, "threads", "main"))
    for _ in range(2000):
        if clean_step(tracee, instruction_at(tracee, tracee.registers.ip)) is not None:
            break
    if tracee.ended is None:
        tracee.resume()
    assert tracee.ended == Ended(exit_code=0, signal=None)
    assert (tmp_path / "stdout").read_text() == "3019\n"


def test_signals_of_the_program_are_its_own(start, tmp_path):
    tracee = start("signals")
    assert tracee.run_to(entry(tracee, "signals", "body"), 4)
    assert tracee.registers.read("rdi") == 3
    for _ in range(40):
        clean_step(tracee, instruction_at(tracee, tracee.registers.ip))
    assert tracee.resume() == Ended(exit_code=0, signal=None)
    expected = 3 * (signal.SIGUSR1 + signal.SIGTRAP)
    assert (tmp_path / "stdout").read_text() == f"{expected}\ncaught\n"


def alive(pid):
    """Running or sleeping; one whose end nobody has asked for yet is not alive."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except FileNotFoundError:
        return False


def test_what_the_program_started_goes_with_it(start, tmp_path):
    tracee = start("parent")
    assert tracee.resume() == Ended(exit_code=0, signal=None)
    code, child = (tmp_path / "stdout").read_text().split()
    assert code == "3"
    assert alive(int(child))
    tracee.kill()
    assert not alive(int(child))


def test_counting_without_stopping(start):
    tracee = start("counting", "77")
    if tracee.mechanism is not Mechanism.PERF:
        pytest.skip("perf_event_open is not allowed here")
    counter = ExecutionCounter(tracee.tid, entry(tracee, "counting", "body"))
    tracee.resume()
    assert counter.read() == 77
    counter.close()


def test_attach_to_a_running_process_and_detach(native_program):
    native_program("counting")  # skips where nothing can be traced
    for _ in range(50):  # it may stop at the end of its exec instead
        process = subprocess.Popen(["cat"], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        tracee = Tracee.attach(process.pid)
        assert tracee.registers.ip
        tracee.detach()
        output, _ = process.communicate(b"on", timeout=60)
        assert (process.returncode, output) == (0, b"on")


THREADS = """
import os, threading, time
for _ in range(4):
    threading.Thread(target=time.sleep, args=(60,)).start()
print(*os.listdir("/proc/self/task"), flush=True)
"""


@pytest.mark.parametrize("is_main", [True, False])
def test_a_process_that_is_killed_before_it_is_detached_ends(native_program, is_main):
    native_program("counting")
    process = subprocess.Popen([sys.executable, "-c", THREADS], stdout=subprocess.PIPE, text=True)
    threads = [int(thread) for thread in process.stdout.readline().split()]
    process.stdout.close()
    target = process.pid if is_main else max(threads)
    tracee = Tracee.attach(process.pid, thread=target)
    assert tracee.tid == target
    process.kill()
    tracee.detach()
    assert tracee.ended == Ended(exit_code=None, signal=signal.SIGKILL)
    process.wait()


def test_what_a_process_starts_while_it_is_traced_outlives_the_tracer(native_program):
    native_program("counting")
    line = "read go; sleep 60 & echo $!; read go"
    with subprocess.Popen(
        ["sh", "-c", line], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
    ) as process:
        children = []

        def trace():
            tracee = Tracee.attach(process.pid)
            process.stdin.write("go\n")
            while not children:
                tracee.run_for(0.05)
                if select.select([process.stdout], [], [], 0)[0]:
                    children.append(int(process.stdout.readline()))
            tracee.detach()

        tracer = threading.Thread(target=trace)
        tracer.start()
        tracer.join()
        assert alive(process.pid)
        assert alive(*children)
        os.kill(*children, signal.SIGTERM)


def test_attaching_to_nothing_is_a_clear_error():
    process = subprocess.Popen(["true"])
    process.wait()
    with pytest.raises(TargetError, match="does not exist"):
        Tracee.attach(process.pid)


def test_a_program_that_is_not_there_is_a_clear_error():
    with pytest.raises(TargetError, match="was not found"):
        Program.of(["/nowhere/at/all"])


def test_a_file_that_cannot_be_executed_is_a_clear_error(tmp_path, native_program):
    native_program("counting")
    broken = tmp_path / "broken"
    broken.write_bytes(b"\x7fELF nonsense")
    broken.chmod(0o755)
    with pytest.raises(TargetError, match="cannot be executed"):
        spawn(Program.of([str(broken)]), stdout=tmp_path / "o", stderr=tmp_path / "e")


_TRACER = """
import sys
import threading
from pathlib import Path
from mavfi_cli.fi.tracer.spawn import Program, run_to_entry, spawn
tracee = spawn(Program.of([sys.argv[1]]), stdout=Path(sys.argv[2]), stderr=Path(sys.argv[2]))
run_to_entry(tracee)
print(tracee.pid, flush=True)
sys.stdin.read()
"""


def test_killing_the_tracer_leaves_no_orphan(native_program, tmp_path):
    tracer = subprocess.Popen(
        [sys.executable, "-c", _TRACER, native_program("sleeper"), tmp_path / "out"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        cwd=Path(__file__).parents[2],
    )
    pid = int(tracer.stdout.readline())
    target = os.pidfd_open(pid)
    tracer.kill()
    tracer.communicate()
    import select

    readable, _, _ = select.select([target], [], [], 10)
    os.close(target)
    assert readable, "the target outlived its tracer"
