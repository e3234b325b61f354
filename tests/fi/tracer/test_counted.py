"""A counted run: its counts, and that a detour stops exactly where a breakpoint does."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from mavfi_cli.fi.tracer.counted import CountedRun, Detour
from mavfi_cli.fi.tracer.decode import decode
from mavfi_cli.fi.tracer.image import Image
from mavfi_cli.fi.tracer.sampling import record_window

RESUME_FLAG = 1 << 16


@pytest.fixture
def counted(start):
    """Function from a program to its image and its counted run, by stepping."""

    def make(name, *arguments):
        tracee = start(name, *arguments)
        image = Image(tracee.pid)
        scope = image.scope([name])
        code = {
            at: tracee.memory.read(at, 16)
            for span in scope.spans
            for at in range(span.start, span.stop)
        }
        trace = record_window(tracee, scope, limit=100_000, program=name)
        return image, CountedRun.of(Counter(trace.tolist()), code.__getitem__)

    return make


@pytest.mark.parametrize(("name", "arguments"), [("counting", ("300",)), ("flows", ())])
def test_a_detour_stops_where_a_breakpoint_does(counted, start, name, arguments):
    image, run = counted(name, *arguments)
    hot = np.flatnonzero(run.counts >= 150)
    assert len(hot) > 8
    for index in hot.tolist():
        k, address = int(run.counts[index]) - 7, int(run.addresses[index])
        detoured, plain = start(name, *arguments), start(name, *arguments)
        for stage in run.stages(index, k, image.locate):
            assert detoured.run_to(image.address(stage.location), stage.count, stage.detour)
        assert plain.run_to(address, k)
        assert seen(detoured, image.named(name)) == seen(plain, image.named(name))
        while detoured.ended is None:
            detoured.resume()
        assert detoured.ended.exit_code == 0
        plain.kill()


def seen(tracee, loaded):
    """All registers but the resume flag, what is mapped, and code and data of the program."""
    general = dict(enumerate(tracee.registers.general()))
    general[18] &= ~RESUME_FLAG
    lines = Path(f"/proc/{tracee.pid}/maps").read_text().splitlines()
    maps = [line.split()[0] for line in lines]
    own = [line.split()[0].split("-") for line in lines if line.endswith(loaded.path)]
    start, end = int(own[0][0], 16), int(own[-1][1], 16)
    memory = tracee.memory.read(start, end - start)
    return general, tracee.registers.extended(), maps, memory


def test_each_kind_of_place_occurs(counted):
    """Long jumps, short ones over bytes that nothing executes, places of a neighbour, and none."""
    image, run = counted("flows")
    assert any(each is not None and each.via for each in run.detours)
    assert any(each is not None and not each.via for each in run.detours)
    assert any(place != index for index, place in enumerate(run.places.tolist()))
    names = {decode_at(image, run, index).mnemonic for index in np.flatnonzero(run.counts > 100)}
    assert {"rep movsb", "call", "jne", "ret"} <= names
    assert run.not_reached == 0.0  # a breakpoint counts what is executed less often


def decode_at(image, run, index):
    address = int(run.addresses[index])
    loaded = image.object_at(address)
    with open(loaded.path, "rb") as file:
        file.seek(address - loaded.bias)
        return decode(file.read(16), address)


def test_all_executed_instructions_are_drawn_alike(counted):
    image, run = counted("flows")
    seen = Counter()
    for position in range(run.executed):
        stages, k = run.trigger(position, image.locate, lambda _: b"")
        seen[run.address(position)] += 1
        assert k == seen[run.address(position)]
        assert stages[-1].location == image.locate(run.address(position))
    assert seen == dict(zip(run.addresses.tolist(), run.counts.tolist(), strict=True))


def test_what_cannot_be_reached_is_not_drawn(start):
    tracee = start("flows")
    entry = tracee.registers.ip
    alone = CountedRun.of({entry: 10**9}, lambda address: b"\xc3" * 16)  # a one-byte block
    assert alone.executed < 10**6
    assert alone.not_reached == pytest.approx(1.0, abs=1e-3)
    assert CountedRun.of({entry: 10**9}, lambda _: tracee.memory.read(entry, 16)).not_reached >= 0.0


def test_a_detour_that_does_not_fit_is_left_to_the_breakpoint(start):
    tracee = start("counting", "300")
    image = Image(tracee.pid)
    body = image.address(image.function("body", ["counting"]))
    assert tracee.run_to(body, 200, Detour(1))  # cuts an instruction
    assert tracee.registers.read("rdi") == 199


def test_a_loop_instruction_is_not_relocated():
    """Its jump reaches 127 bytes, so a copy elsewhere would jump to another place."""
    increment, loop = b"\x48\xff\xc0", b"\xe2\xfb"
    code = increment + loop
    assert Detour(5).code(code, 0x401000, 0x501000, 3) is None
    assert Detour.at(0x401000, lambda at: code[at - 0x401000 :], lambda _: 7) is None
