"""Every bit of every register class is flipped and read back; nothing else changes."""

import pytest
from native_programs import all_registers as all_names

from mavfi_cli.fi.tracer.image import Image

# Bits of RFLAGS that Linux lets a tracer change: the status flags, trap, direction, resume and
# alignment check. Bit 14 (nested task) is left out: whether it sticks depends on the kernel.
STICKY = {0, 2, 4, 6, 7, 8, 10, 11, 16, 18}
NEVER = {1, 3, 5, 9, 12, 13, 15, 17, *range(19, 32)}


def state_of(tracee, names):
    tracee.registers.forget()
    return {name: tracee.registers.read(name) for name in names}


def flip_every_bit(tracee, name, width, others, step=1):
    registers = tracee.registers
    original = registers.read(name)
    before = state_of(tracee, others)
    for bit in range(0, width, step):
        registers.write(name, original ^ (1 << bit))
        assert registers.read(name) == original ^ (1 << bit), f"{name} bit {bit}"
    assert state_of(tracee, others) == before
    registers.write(name, original)
    assert registers.read(name) == original


def test_every_bit_of_every_general_register(start):
    from mavfi_cli.fi.tracer.decode import GENERAL

    tracee = start("counting")
    for name in GENERAL:
        flip_every_bit(tracee, name, 64, [n for n in all_names() if n != name])


@pytest.mark.parametrize("family", ["st", "xmm", "ymm", "zmm", "k"])
def test_every_bit_of_every_wide_register(start, family):
    from mavfi_cli.fi.tracer.registers import width_of

    tracee = start("counting")
    known = all_names()
    widest = next(name for name in known if name.startswith(("xmm", "ymm", "zmm")))
    order = ["xmm", "ymm", "zmm"]
    if family in order:
        if order.index(family) > order.index(widest[:3]):
            pytest.skip(f"this processor has no {family} registers")
        names = [f"{family}{n[3:]}" for n in known if n.startswith(widest[:3])]
    else:
        names = [n for n in known if n.startswith(family)]
        if not names:
            pytest.skip(f"this processor has no {family} registers")
    for name in names:
        number = name.lstrip("stxyzmk")
        others = [n for n in known if n.lstrip("stxyzmk") != number or n[:1] != name[:1]]
        others = [n for n in others if not (family in order and n == f"{widest[:3]}{number}")]
        flip_every_bit(tracee, name, width_of(name), others)


def test_a_part_of_a_vector_register_leaves_the_rest(start):
    tracee = start("counting")
    widest = next(n[:3] for n in all_names() if n.startswith(("ymm", "zmm")))
    registers = tracee.registers
    pattern = int.from_bytes(bytes(range(1, 65)), "little") & (
        (1 << {"y": 256, "z": 512}[widest[0]]) - 1
    )
    registers.write(f"{widest}3", pattern)
    registers.write("xmm3", 0)
    assert registers.read(f"{widest}3") == pattern >> 128 << 128


def test_the_upper_half_of_ymm_is_written_while_its_component_is_unused(start):
    from mavfi_cli.fi.tracer.registers import AVX, XSTATE_BV

    tracee = start("counting")
    area = tracee.registers.extended()
    unused = [
        bit
        for bit in (AVX, 6, 7)
        if not int.from_bytes(area[XSTATE_BV : XSTATE_BV + 8], "little") >> bit & 1
    ]
    if not unused:
        pytest.skip("every vector component is in use at the entry point")
    tracee.registers.write("ymm9", 1 << 255)
    assert tracee.registers.read("ymm9") == 1 << 255


@pytest.mark.parametrize("bit", sorted(STICKY | NEVER))
def test_which_flags_stick(start, bit):
    tracee = start("counting")
    before = tracee.registers.read("rflags")
    others = [name for name in all_names() if name != "rflags"]
    rest = state_of(tracee, others)
    tracee.registers.write("rflags", before ^ (1 << bit))
    changed = tracee.registers.read("rflags") ^ before
    assert changed == (1 << bit if bit in STICKY else 0)
    assert state_of(tracee, others) == rest


def test_flipped_registers_reach_the_program(start, tmp_path):
    tracee = start("counting", "100")
    image = Image(tracee.pid)
    assert tracee.run_to(image.address(image.function("body", ["counting"])), 100)
    tracee.registers.write("rdi", 99 ^ (1 << 40))
    tracee.resume()
    assert (tmp_path / "stdout").read_text().startswith(f"{99 ^ 1 << 40} ")
