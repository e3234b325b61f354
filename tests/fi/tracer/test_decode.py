"""What instructions read and write, as bits of full registers."""

import pytest

pytest.importorskip("capstone")
arch = pytest.importorskip("platform")
if arch.machine() != "x86_64":
    pytest.skip("x86-64 only", allow_module_level=True)

from mavfi_cli.fi.tracer.decode import decode  # noqa: E402

FULL = (1 << 64) - 1


def of(code):
    return decode(bytes.fromhex(code).ljust(16, b"\x90"), 0x1000)


def masks(uses):
    return {(use.operand, use.mask) for use in uses}


def names(uses):
    return {use.operand for use in uses}


def test_a_32_bit_write_clears_the_upper_half():
    (written,) = of("89d8").writes  # mov eax, ebx
    assert (written.register, written.mask, written.clears) == ("rax", 0xFFFF_FFFF, FULL)


def test_an_8_bit_write_leaves_the_rest():
    (written,) = of("b401").writes  # mov ah, 1
    assert (written.register, written.mask, written.clears) == ("rax", 0xFF00, 0xFF00)


def test_implicit_operands_are_named():
    multiply = of("48f7e1")  # mul rcx
    assert names(multiply.reads) == {"rax", "rcx"}
    assert {"rax", "rdx", "cf", "of"} <= names(multiply.writes)
    copy = of("f348a5")  # rep movsq
    assert {"rsi", "rdi", "rcx", "df"} <= names(copy.reads)
    assert copy.run_over


def test_flags_are_single_bits():
    assert masks(of("7405").reads) == {("zf", 1 << 6)}  # je
    assert {"cf", "pf", "af", "zf", "sf", "of"} == names(of("01c3").writes) - {"ebx"}


def test_zeroing_reads_nothing():
    for code in ("31c0", "660fefc0", "c5fdefc0", "0f57c0"):
        assert of(code).reads == (), of(code).text


def test_a_conditional_move_may_not_write():
    (written,) = of("480f4cc3").writes  # cmovl rax, rbx
    assert (written.mask, written.clears) == (FULL, 0)
    (half,) = of("0f4cc3").writes  # cmovl eax, ebx: clears the upper half anyway
    assert (half.mask, half.clears) == (0xFFFF_FFFF, FULL ^ 0xFFFF_FFFF)


def test_vex_clears_the_rest_and_legacy_scalar_keeps_it():
    vex, legacy = of("c5f358c2").writes[0], of("f20f58c1").writes[0]
    assert vex.register == legacy.register == "zmm0"
    assert vex.clears == (1 << 512) - 1
    assert legacy.clears == FULL


def test_memory_operands_have_addresses():
    load = of("8b4411fc")  # mov eax, [rcx + rdx - 4]
    (use,) = load.memory
    registers = {"rcx": 0x2000, "rdx": 0x10}
    assert (use.reads, use.writes, use.size) == (True, False, 4)
    assert use.address(load, registers.get) == 0x200C
    relative = of("8b0500010000")
    assert relative.memory[0].address(relative, registers.get) == 0x1000 + 6 + 0x100


def test_lea_touches_no_memory():
    assert of("8d0411").memory == ()


@pytest.mark.parametrize(
    ("code", "offset", "reads"),
    [("50", -8, False), ("58", 0, True), ("c3", 0, True), ("f3c3", 0, True), ("f2c3", 0, True)],
)
def test_push_pop_and_ret_use_the_stack(code, offset, reads):
    instruction = of(code)
    use = instruction.memory[-1]
    assert use.address(instruction, {"rsp": 0x7000}.get) == 0x7000 + offset
    assert (use.reads, use.writes) == (reads, not reads)


def test_a_return_with_a_prefix_is_stepped_like_any_other():
    """Compilers wrote `rep ret` for years; the instruction behind it may never execute."""
    assert of("f3c3").branches
    assert not of("f3c3").run_over


def test_no_instruction_is_none():
    assert of("0604") is None


@pytest.mark.parametrize("code", ["f20f114570", "f20f104508", "f20f10c1"])
def test_the_scalar_move_is_not_the_string_move_of_the_same_name(code):
    assert of(code).mnemonic == of("a5").mnemonic == "movsd"
    assert "df" not in names(of(code).reads)
    assert "df" in names(of("a5").reads)
