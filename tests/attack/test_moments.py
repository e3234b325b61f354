"""Faults at a moment, in a process with several threads that runs by the wall clock."""

import contextlib
import ctypes
import faulthandler
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from live_processes import LONG_S

from mavfi_cli.attack.live import _Search, attack_moment
from mavfi_cli.attack.tracer_thread import TracerThread
from mavfi_cli.core.errors import FaultError, TargetError, TracingForbidden, UnknownName
from mavfi_cli.core.processes import fork
from mavfi_cli.fi.tracer import record, stepper
from mavfi_cli.fi.tracer.fault import Strategy
from mavfi_cli.fi.tracer.image import Image
from mavfi_cli.fi.tracer.tracee import Tracee

UNIFORM = Strategy.of("instruction-uniform")


@pytest.fixture
def workers(native_program):
    """A program whose three threads call `work` again and again; it prints its calls when asked.

    At a "!" its main thread does the same.
    """
    with subprocess.Popen(
        [native_program("workers")], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "ready\n"
        while calls(process) < 100_000:  # a thread is drawn by the CPU time that it has used
            time.sleep(0.1)
        yield process
        process.kill()


def strike(process, tmp_path, plan=UNIFORM, seed=1, **settings):
    path = tmp_path / "fault.json"
    rng = np.random.default_rng(seed)
    tracer = TracerThread(
        lambda _: attack_moment(process.pid, plan, rng, path=path, kernel="workers", **settings)
    )
    attack = tracer.result()
    assert record.read(path) == attack.record
    return {**attack.record, "symbol": attack.name_symbol()}


def calls(process):
    process.stdin.write("?\n")
    process.stdin.flush()
    return int(process.stdout.readline())


def test_any_thread_that_calls_the_function_is_struck_and_all_go_on(workers, tmp_path):
    scope = {"objects": ("workers",), "function": "work"}
    places = set()
    for seed in range(8):
        done = strike(workers, tmp_path, seed=seed, null=True, **scope)
        assert done["not_injected_reason"] == ""
        assert done["symbol"].startswith("work+")
        places.add((done["offset"], done["k"]))
    assert len(places) > 4
    before = calls(workers)
    time.sleep(0.05)
    assert calls(workers) > before
    assert workers.poll() is None


def test_a_recorded_instruction_is_struck_again(workers, tmp_path):
    first = strike(workers, tmp_path, objects=("workers",), null=True, seed=3)
    drawn = strike(workers, tmp_path, objects=("workers",), seed=3, repeat=first)
    assert drawn["offset"] == first["offset"]
    assert (drawn["object"], drawn["instruction"]) == ("workers", first["instruction"])


def test_a_rule_of_time_strikes_where_the_thread_is(workers, tmp_path):
    done = strike(workers, tmp_path, plan=Strategy.of("", compat="rosfi-2021"), seed=2)
    assert done["injection"]["applied"]
    assert done["k"] == 0
    assert set(done["corruption"]["bits"]) <= set(range(8))


def test_what_cannot_be_struck(workers, tmp_path):
    with pytest.raises(UnknownName, match="did you mean 'workers'"):
        strike(workers, tmp_path, objects=("worker",))
    with pytest.raises(UnknownName, match="wrok"):
        strike(workers, tmp_path, objects=("workers",), function="wrok")
    tracer = TracerThread(
        lambda _: attack_moment(
            workers.pid, UNIFORM, np.random.default_rng(0), path=tmp_path / "fault.json",
            objects=("workers",), function="never",
        )
    )  # fmt: skip
    until_s = time.monotonic() + LONG_S
    status = Path(f"/proc/{workers.pid}/status")
    while "TracerPid:\t0" in status.read_text() and time.monotonic() < until_s:
        pass
    workers.kill()
    with contextlib.suppress(TargetError):  # it was killed before its thread had stopped
        assert tracer.result().record["not_injected_reason"] == "the process ended"


def test_a_process_whose_files_cannot_be_read_cannot_be_traced(workers, tmp_path):
    """As without CAP_SYS_PTRACE, if the process has set PR_SET_DUMPABLE to 0."""

    def from_another_user_namespace():
        if ctypes.CDLL(None).unshare(0x1000_0000) != 0:
            return 77
        with pytest.raises(TracingForbidden, match=r"'/proc/.*--cap-add=SYS_PTRACE"):
            attack_moment(
                workers.pid, UNIFORM, np.random.default_rng(0), path=tmp_path / "fault.json"
            )
        return 0

    _, status = os.waitpid(fork(from_another_user_namespace), 0)
    if (code := os.waitstatus_to_exitcode(status)) == 77:
        pytest.skip("no user namespaces are allowed here")
    assert code == 0


def test_a_program_without_symbols_has_no_function_to_choose(native_program, tmp_path):
    stripped = tmp_path / "stripped"
    subprocess.run(["strip", "-o", stripped, native_program("workers")], check=True)
    with subprocess.Popen([stripped], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        with pytest.raises(FaultError, match="stripped: no function 'work': no symbol table"):
            strike(process, tmp_path, objects=("stripped",), function="work")
        process.kill()


def test_a_program_that_is_killed_while_its_thread_is_stopped_ends_the_fault(
    workers, tmp_path, monkeypatch
):
    def killed(_):
        workers.kill()
        raise ProcessLookupError

    monkeypatch.setattr("mavfi_cli.attack.live._Search.fault", killed)
    assert strike(workers, tmp_path)["not_injected_reason"] == "the process ended"


def test_compiled_steps_strike_the_drawn_execution(start, monkeypatch):
    def faults():
        for seed in range(6):
            tracee = start("flows")
            image = Image(tracee.pid)
            scope = image.scope(("flows", "libc.so.6"))
            rng = np.random.default_rng(seed)
            fault, reason = _Search(tracee, image, scope, None, UNIFORM, rng).fault()
            assert not reason
            yield fault, tracee.registers.ip

    monkeypatch.setattr("mavfi_cli.attack.live._STEPPED_S", LONG_S)
    compiled = list(faults())
    monkeypatch.setattr(_Search, "_steps", lambda search, _: search._step() or 1)
    assert compiled == list(faults())
    assert len({fault.execution for fault, _ in compiled}) > 4


def test_a_waiting_thread_is_struck_once_it_goes_on_and_nothing_else_waits(
    workers, tmp_path, monkeypatch
):
    monkeypatch.setattr("mavfi_cli.attack.live._drawn_thread", lambda pid, _: pid)
    monkeypatch.setattr("mavfi_cli.attack.live.MOST_STEPS", 50)
    faulthandler.dump_traceback_later(LONG_S, exit=True)  # no Python would run if a step blocked it
    tracer = TracerThread(
        lambda _: attack_moment(
            workers.pid, UNIFORM, np.random.default_rng(1), path=tmp_path / "fault.json", null=True
        )
    )
    try:
        while "TracerPid:\t0" in Path(f"/proc/{workers.pid}/status").read_text():
            time.sleep(0.01)
        time.sleep(0.3)
        assert not tracer.done
        assert calls(workers) > 0
        done = tracer.result().record
    finally:
        faulthandler.cancel_dump_traceback_later()
    assert done["not_injected_reason"] == ""
    assert 0 < done["k"] <= 50
    assert calls(workers) > 0


def test_loading_the_steps_waits_for_no_child_of_this_process():
    faulthandler.dump_traceback_later(LONG_S, exit=True)
    with subprocess.Popen(["sleep", "600"]) as child:
        try:
            stepper.load()
            assert child.poll() is None
        finally:
            faulthandler.cancel_dump_traceback_later()
            child.kill()


def test_a_program_that_is_killed_while_its_main_thread_is_stepped(workers, tmp_path, monkeypatch):
    workers.stdin.write("!")
    workers.stdin.flush()
    monkeypatch.setattr("mavfi_cli.attack.live._drawn_thread", lambda pid, _: pid)
    for name, value in {"MOST_STEPS": 10**9, "_AT_ONCE": 10**6, "_STEPPED_S": LONG_S}.items():
        monkeypatch.setattr(f"mavfi_cli.attack.live.{name}", value)
    with subprocess.Popen(["sh", "-c", f"sleep 0.3; kill -9 {workers.pid}"]):
        done = strike(workers, tmp_path, objects=("workers",))
    assert done["not_injected_reason"] == "the process ended"


def test_a_program_that_is_killed_before_its_thread_has_stopped(workers, tmp_path, monkeypatch):
    def killed(_):
        workers.kill()
        raise ProcessLookupError

    monkeypatch.setattr("mavfi_cli.fi.tracer.tracee.Tracee.interrupt", killed)
    with pytest.raises(TargetError, match="has ended"):
        strike(workers, tmp_path)


def test_other_threads_run_while_a_thread_is_stepped():
    everywhere = np.array([[0, 1 << 47]])
    with subprocess.Popen([sys.executable, "-c", "while True: pass"]) as process:

        def step():
            tracee = Tracee.attach(process.pid)
            trace = np.empty(200_000, np.int64)
            executed, why, _ = stepper.record_steps(
                tracee.tid, tracee.group, everywhere, trace, stepper.NO_END
            )
            ends.append((executed, why))
            tracee.detach()

        time.sleep(0.5)  # the interpreter has started and makes no system call
        stepper.load()
        ends, turns = [], 0
        tracer = threading.Thread(target=step)
        tracer.start()
        while tracer.is_alive():
            time.sleep(0.001)
            turns += 1
        process.kill()
    assert ends == [(200_000, stepper.FULL)]
    assert turns > 50  # one call steps for nearly the whole time
