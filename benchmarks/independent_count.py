"""Compares PINFI's rule in mavfi and in an emulator: outcome shares, and the same faults in both.

    python benchmarks/independent_count.py --out FOLDER [--runs 5000]
        [--emulated 2000] [--pairs 500] [--jobs 2] [--program NAME ...] [--sources FOLDER]
        [--hang-ratio 200]

For each program of tests/programs, or of another folder of C files:

1. `mavfi kernels --program --compat pinfi` injects faults.
2. The emulator (benchmarks/emulator.py) injects faults of its own. It draws an executed
   instruction uniformly, one register that it writes, and a bit, by code of its own.
3. The emulator repeats mavfi's recorded faults: same instruction, same execution, same bits. The
   value of the register before and after the flip, the outcome and the output must be the same.

One table shows the shares of both with the difference and its 95 % interval (Newcombe's method 10),
and another shows how many pairs agree. `FOLDER/counts.csv` holds all counts, and
`FOLDER/NAME-*.jsonl` the individual faults. The same command resumes an interrupted run.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import math
import multiprocessing
import re
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import capstone
import numpy as np
from capstone import x86 as cx86
from elftools.elf.elffile import ELFFile
from emulator import ENVIRONMENT, NOT_EMULATED, Emulation, End, Snapshot, take_snapshot

from mavfi_cli.stats.shares import wilson

SOURCES = Path(__file__).parents[1] / "tests" / "programs"
OUTCOMES = ("benign", "crash", "hang", "sdc")
HANG_RATIO = 200  # times the golden basic blocks; mavfi allows 10 times the CPU time, plus 1 s,
# which is the same for a program that takes 5 ms
EXCLUDED = ("_start", "__libc", "__do_global", "frame_dummy", "call_gmon_start", "__stat")
CARRY, PARITY, ZERO, SIGN, DIRECTION, OVERFLOW = 0, 2, 6, 7, 10, 11
VISIBLE = {"flags": (1 << 32) - 1, "general": (1 << 64) - 1, "vector": (1 << 128) - 1}
ARITHMETIC = (CARRY, PARITY, 4, ZERO, SIGN, DIRECTION, OVERFLOW)
TESTED = {
    "o": OVERFLOW, "s": SIGN, "e": ZERO, "b": CARRY, "ae": CARRY, "l": SIGN, "ge": SIGN,
    "p": PARITY,
}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Struck:
    """The operand that a fault corrupts, and the bits or the jump condition that it flips.

    Attributes:
        operand: a register as the assembler names it, `flags`, or `memory`.
        jump: a conditional jump that the flip inverts; empty if `bits` are flipped.
        bits: bits of the operand.
    """

    operand: str
    bits: tuple[int, ...] = ()
    jump: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """A fault at the k-th execution of an instruction, which `address` locates in the file."""

    address: int
    k: int
    struck: Struck


# --- the rule


def width_of(register: str) -> tuple[int, int]:
    """Return the first bit and the number of bits that a register's name denotes.

    The bits are counted within the full register.
    """
    if register.startswith(("xmm", "ymm")):
        return 0, 64
    if re.fullmatch(r"[abcd]h", register):
        return 8, 8
    if re.fullmatch(r"r\d+[dwb]", register):
        return 0, {"d": 32, "w": 16, "b": 8}[register[-1]]
    if register.endswith("l"):
        return 0, 8
    return 0, {"r": 64, "e": 32}.get(register[0], 16)


def full_register(register: str) -> str:
    """Return the name of the full register of which a register is a part."""
    if numbered := re.fullmatch(r"(r\d+)[dwb]?", register):
        return numbered[1]
    if vector := re.fullmatch(r"[xyz](mm\d+)", register):
        return f"x{vector[1]}"
    letters = re.fullmatch(r"[re]?([a-d])[xhl]|[re]?(si|di|bp|sp)l?", register)
    if letters is None:
        raise ValueError(f"cannot find the full register of the unknown register {register}")
    return f"r{letters[1]}x" if letters[1] else f"r{letters[2]}"


class Code:
    """The instructions of a program's own functions, and the rule by which PINFI attacks them."""

    def __init__(self, program: Path) -> None:
        self._decoder = capstone.Cs(capstone.CS_ARCH_X86, capstone.CS_MODE_64)
        self._decoder.detail = True
        self.instructions: dict[int, capstone.CsInsn] = {}
        with program.open("rb") as file:
            elf = ELFFile(file)
            text = elf.get_section_by_name(".text")
            self.first = text["sh_addr"]
            self.data = text.data()
            symbols = elf.get_section_by_name(".symtab").iter_symbols()
            for symbol in symbols:
                if symbol["st_info"]["type"] == "STT_FUNC" and self._own(symbol):
                    self._disassemble(symbol["st_value"], symbol["st_size"])

    def _own(self, symbol: Any) -> bool:
        inside = 0 <= symbol["st_value"] - self.first < len(self.data)
        return inside and not symbol.name.startswith(EXCLUDED)

    def _disassemble(self, start: int, size: int) -> None:
        offset = start - self.first
        for each in self._decoder.disasm(self.data[offset : offset + size], start):
            self.instructions[each.address] = each

    def targets(self) -> list[int]:
        """Return the addresses of the instructions that PINFI attacks."""
        return [address for address in self.instructions if self.written(address)]

    def written(self, address: int) -> list[str]:
        """Return the registers that an instruction writes; none if PINFI does not attack it."""
        found = self.instructions[address]
        groups = (cx86.X86_GRP_JUMP, cx86.X86_GRP_CALL, cx86.X86_GRP_RET)
        if any(found.group(group) for group in groups) or found.mnemonic.startswith("nop"):
            return []
        numbers = sorted(set(found.regs_access()[1]))
        return [found.reg_name(number) for number in numbers]

    def draw(self, address: int, rng: np.random.Generator) -> Struck:
        """Draw the operand and the bit that a fault flips at an instruction."""
        registers = [name for name in self.written(address) if name != "rflags"]
        if registers:
            register = registers[int(rng.integers(len(registers)))]
            first, width = width_of(register)
            return Struck(operand=register, bits=(first + int(rng.integers(width)),))
        found = self.instructions[address]
        following = self.instructions.get(address + found.size)
        if following is not None and self._conditional(following):
            return Struck(operand="flags", jump=following.mnemonic)
        for operand in found.operands:
            if operand.type == cx86.X86_OP_MEM and operand.access & capstone.CS_AC_WRITE:
                return Struck(operand="memory", bits=(int(rng.integers(8 * operand.size)),))
        bit = int(rng.integers(64))
        return Struck(operand="flags", bits=(bit,) if bit in ARITHMETIC else ())

    def _conditional(self, found: capstone.CsInsn) -> bool:
        return bool(found.group(cx86.X86_GRP_JUMP)) and found.mnemonic != "jmp"

    def memory_operand(self, address: int, run: Emulation) -> int:
        """Return the address of the memory operand of an instruction that is about to execute."""
        found = self.instructions[address]
        place = next(o.mem for o in found.operands if o.type == cx86.X86_OP_MEM)
        value = place.disp + (found.size if found.reg_name(place.base) == "rip" else 0)
        if place.base:
            value += run[found.reg_name(place.base)]
        if place.index:
            value += run[found.reg_name(place.index)] * place.scale
        return value & ((1 << 64) - 1)


def inverted(flags: int, jump: str) -> int:
    """Return the flags, changed so that a conditional jump goes the other way."""
    condition = jump.removeprefix("j")
    carry, zero, sign, overflow = (flags >> bit & 1 for bit in (CARRY, ZERO, SIGN, OVERFLOW))
    if condition in ("be", "a"):
        if carry or zero:
            return flags & ~(1 << CARRY) & ~(1 << ZERO)
        return flags | 1 << ZERO
    if condition in ("le", "g"):
        if zero or sign != overflow:
            undone = flags & ~(1 << ZERO)
            return undone ^ (1 << SIGN) if sign != overflow else undone
        return flags | 1 << ZERO
    return flags ^ 1 << TESTED[condition if condition in TESTED else condition.removeprefix("n")]


# --- one fault in the emulator


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """The outcome of a fault, and the values of the whole register before and after the flip.

    The values are None for a fault in memory.
    """

    outcome: str
    output_sha256: str
    before: int | None
    after: int | None
    reason: str


@dataclass(frozen=True, kw_only=True, eq=False)
class Bench:
    """A program with its golden run and its executed instructions, ready for faults."""

    snapshot: Snapshot
    code: Code
    golden: End
    addresses: np.ndarray  # (n,) of the file, of the instructions that count
    executions: np.ndarray  # (n,)
    hang_ratio: int

    @classmethod
    def of(cls, program: Path, hang_ratio: int = HANG_RATIO) -> Bench:
        """Run a program once for the golden run, and once to count executions."""
        snapshot, code = take_snapshot(program), Code(program)
        golden = Emulation(snapshot).finish(1 << 40)
        if golden.exit_code != 0:
            raise RuntimeError(f"{program.name} fails without a fault: {golden}")
        start = snapshot.bias + code.first
        counts = Emulation(snapshot).count_executions(start, start + len(code.data) - 1)
        addresses = np.array(code.targets(), np.int64)
        return cls(
            snapshot=snapshot, code=code, golden=golden, addresses=addresses,
            executions=counts[addresses - code.first], hang_ratio=hang_ratio,
        )  # fmt: skip

    def draw(self, seed: int, number: int) -> Fault:
        """Draw the fault with a number, uniformly over all executed instructions."""
        rng = np.random.default_rng([seed, number])
        ends = np.cumsum(self.executions)
        position = int(rng.integers(ends[-1]))
        index = int(np.searchsorted(ends, position, side="right"))
        k = position - int(ends[index] - self.executions[index]) + 1
        address = int(self.addresses[index])
        return Fault(address=address, k=k, struck=self.code.draw(address, rng))

    def strike(self, fault: Fault) -> Result:
        """Run the program with a fault, and return what the fault did."""
        run = Emulation(self.snapshot)
        if not run.run_to(self.snapshot.bias + fault.address, fault.k):
            raise RuntimeError(f"{fault}: the program never reaches the instruction")
        before, after = self._flip(run, fault)
        ended = run.finish(self.hang_ratio * self.golden.blocks)
        return Result(
            outcome=self._outcome(ended), output_sha256=hashlib.sha256(ended.output).hexdigest(),
            before=before, after=after, reason=ended.reason,
        )  # fmt: skip

    def _flip(self, run: Emulation, fault: Fault) -> tuple[int | None, int | None]:
        struck = fault.struck
        if struck.operand == "memory":
            (bit,) = struck.bits
            place = self.code.memory_operand(fault.address, run) + bit // 8
            (byte,) = run.engine.mem_read(place, 1)
            run.engine.mem_write(place, bytes([byte ^ 1 << bit % 8]))
            return None, None
        run.step()
        register = "eflags" if struck.operand == "flags" else full_register(struck.operand)
        before = run[register]
        after = before ^ sum(1 << bit for bit in struck.bits)
        if struck.jump:
            after = inverted(before, struck.jump)
        run[register] = after
        if run[register] != after:
            raise RuntimeError(f"{fault}: the register does not keep the flipped value")
        return before, after

    def _outcome(self, ended: End) -> str:
        if ended.reason == NOT_EMULATED:
            return "unknown"
        if ended.hangs:
            return "hang"
        if ended.exit_code != self.golden.exit_code:
            return "crash"
        return "benign" if ended.output == self.golden.output else "sdc"


# --- mavfi


def build(source: Path, folder: Path) -> Path:
    """Compile a program with the command in a comment of its source. Return the program's path."""
    command = re.search(r"^ \* +(gcc .+)$", source.read_text(), re.MULTILINE)
    assert command is not None, f"{source} names no command"
    shutil.copy(source, folder)
    subprocess.run(command[1].split(), cwd=folder, check=True)
    return (folder / source.stem).resolve()


def inject(program: Path, out: Path, *, runs: int, jobs: int) -> list[dict[str, Any]]:
    """Have mavfi inject faults into a program, and return the records, sorted by run."""
    command = [
        sys.executable, "-m", "mavfi_cli", "kernels", "--program", str(program),
        "--compat", "pinfi", "--runs", str(runs),
        "--jobs", str(jobs), "--out", str(out.resolve()),
        *(f"--env={name}={value}" for name, value in ENVIRONMENT.items()),
    ]  # fmt: skip
    subprocess.run(command, env={"PATH": ENVIRONMENT["PATH"]}, check=True)
    lines = (out / "runs.jsonl").read_text().splitlines()
    return sorted(map(json.loads, lines), key=lambda record: record["run"])


def recorded_fault(record: dict[str, Any]) -> Fault:
    """Return the fault that a record of mavfi contains."""
    address, corruption = record["offset"], record["corruption"]
    site, bits = corruption["site"], tuple(corruption["bits"])
    if site == "memory":
        struck = Struck(operand="memory", bits=bits)
    elif site == "flags":
        jump = corruption.get("inverts", "")
        struck = Struck(operand="flags", bits=() if jump else bits, jump=jump)
    else:
        struck = Struck(operand=corruption["register"], bits=bits)
    return Fault(address=address, k=record["k"], struck=struck)


# --- both


@dataclass(frozen=True, kw_only=True)
class Work:
    """The faults that the emulator injects into one program, in forks of this process."""

    bench: Bench
    seed: int

    def own(self, number: int) -> dict[str, Any]:
        """Draw and inject one of the emulator's own faults. Return fault and result as a dict."""
        fault = self.bench.draw(self.seed, number)
        return {"run": number, **asdict(fault), **asdict(self.bench.strike(fault))}

    def repeated(self, record: dict[str, Any]) -> dict[str, Any]:
        """Inject a fault that mavfi has recorded. Return fault, result and differences."""
        fault = recorded_fault(record)
        result = self.bench.strike(fault)
        return {
            "run": record["run"], **asdict(fault), **asdict(result),
            "recorded_outcome": record["outcome"], "differs": differences(record, result),
        }  # fmt: skip


def differences(record: dict[str, Any], result: Result) -> list[str]:
    """Return the values that differ between a run of mavfi and its repetition in the emulator."""
    found = [] if record["outcome"] == result.outcome else ["outcome"]
    finished = result.outcome in ("benign", "sdc")
    if finished and not found and record["output_sha256"] != result.output_sha256:
        found.append("output")
    if result.before is not None:
        for name, value in (("before", result.before), ("after", result.after)):
            if int(record["injection"][name], 16) & VISIBLE[record["corruption"]["site"]] != value:
                found.append(name)
    return found


_function: Callable[[Any], dict[str, Any]]  # of a worker; it cannot be pickled


def _inherit(function: Callable[[Any], dict[str, Any]]) -> None:
    global _function
    _function = function


def _perform(item: Any) -> dict[str, Any]:
    return _function(item)


def _number(item: Any) -> int:
    return int(item["run"]) if isinstance(item, dict) else int(item)


def in_parallel(
    function: Callable[[Any], dict[str, Any]], items: Sequence[Any], path: Path, jobs: int
) -> list[dict[str, Any]]:
    """Apply a function, in forks, to the items whose results are not in a file yet.

    The file gets the new results. Return all results in the file, sorted by run.
    """
    path.touch()
    done = [json.loads(line) for line in path.read_text().splitlines()]
    known = {each["run"] for each in done}
    left = [each for each in items if _number(each) not in known]
    context = multiprocessing.get_context("fork")
    with path.open("a") as file, context.Pool(jobs, _inherit, (function,)) as pool:
        for result in pool.imap_unordered(_perform, left):
            file.write(json.dumps(result) + "\n")
            file.flush()
            done.append(result)
            if len(done) % 100 == 0:
                print(f"{path.stem}: {len(done)} of {len(items)}", file=sys.stderr)
    return sorted(done, key=lambda each: each["run"])


def newcombe(a: int, m: int, b: int, n: int) -> tuple[float, float, float]:
    """Return the difference of the shares a / m and b / n, and the ends of its 95 % interval.

    The interval is that of R. G. Newcombe, Stat. Med. 17, 1998.
    """
    first, second = wilson(a, m), wilson(b, n)
    low = math.hypot(first.share - first.low, second.high - second.share)
    high = math.hypot(first.high - first.share, second.share - second.low)
    difference = first.share - second.share
    return difference, difference - low, difference + high


def shares_table(name: str, ours: list[str], theirs: list[str]) -> None:
    """Print the share of each outcome in mavfi and in the emulator, and their difference."""
    print(f"\n{name}: {len(ours)} runs of mavfi, {len(theirs)} of the emulator")
    for outcome in OUTCOMES:
        a, b = ours.count(outcome), theirs.count(outcome)
        difference, low, high = newcombe(a, len(ours), b, len(theirs))
        print(
            f"| {outcome} | {100 * a / len(ours):.1f} % | {100 * b / len(theirs):.1f} % "
            f"| {100 * difference:+.1f} ({100 * low:+.1f} to {100 * high:+.1f}) |"
        )


def compare(
    source: Path, folder: Path, *, runs: int, emulated: int, pairs: int, jobs: int, hang_ratio: int
) -> list[list[Any]]:
    """Compare mavfi and the emulator on one program. Return the rows of its counts."""
    name, program = source.stem, build(source, folder)
    work = Work(bench=Bench.of(program, hang_ratio), seed=1)
    print(f"{name}: {work.bench.executions.sum()} executed instructions that count")
    theirs = in_parallel(work.own, range(emulated), folder / f"{name}-emulator.jsonl", jobs)
    records = inject(program, folder / f"{name}-mavfi", runs=runs, jobs=jobs)
    struck = [record for record in records if record["outcome"] in OUTCOMES]
    paired = in_parallel(work.repeated, struck[:pairs], folder / f"{name}-pairs.jsonl", jobs)
    shares_table(name, [r["outcome"] for r in struck], [r["outcome"] for r in theirs])
    differing = [each for each in paired if each["differs"]]
    print(f"{len(paired) - len(differing)} of {len(paired)} faults of mavfi did the same in both")
    for each in differing:
        print(f"  run {each['run']}: {each['recorded_outcome']} in mavfi, {each}")
    rows = []
    for injector, outcomes in (
        ("mavfi", [r["outcome"] for r in records]), ("emulator", [r["outcome"] for r in theirs]),
        ("mavfi's faults in the emulator", [r["outcome"] for r in paired]),
        ("the same in mavfi", [r["recorded_outcome"] for r in paired]),
    ):  # fmt: skip
        counts = Counter(outcomes)
        rows += [[name, injector, len(outcomes), each, counts[each]] for each in sorted(counts)]
    return rows


def main() -> None:
    """Compare mavfi and the emulator on all programs, and write the counts."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--runs", type=int, default=5000, help="of mavfi")
    parser.add_argument("--emulated", type=int, default=2000, help="runs of the emulator")
    parser.add_argument("--pairs", type=int, default=500, help="runs of mavfi that it repeats")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--program", action="append", default=[], help="default: all")
    parser.add_argument("--sources", type=Path, default=SOURCES, help="default: tests/programs")
    parser.add_argument("--hang-ratio", type=int, default=HANG_RATIO, help="limit, golden blocks")
    arguments = parser.parse_args()
    folder = arguments.out.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    names = arguments.program or sorted(path.stem for path in arguments.sources.glob("*.c"))
    rows = [["program", "injector", "runs", "outcome", "count"]]
    counted = ("runs", "emulated", "pairs", "jobs", "hang_ratio")
    numbers = {name: getattr(arguments, name) for name in counted}
    for name in names:
        rows += compare(arguments.sources / f"{name}.c", folder, **numbers)
    with (folder / "counts.csv").open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)


if __name__ == "__main__":
    main()
