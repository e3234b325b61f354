"""Plans one exact instruction-level fault of a mission from the user's request.

The orders that the golden run gave to each node, the number of entries of each kernel, and each
profile are kept below the output folder, under a hash of everything that they depend on.
"""

from __future__ import annotations

import hashlib
import json
import pickle
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from mavfi_cli.attack.kernels.scope import kernel_of_node
from mavfi_cli.attack.profile import TargetProfile
from mavfi_cli.core.errors import FaultError, RecordError
from mavfi_cli.core.files import own_digest, write_atomically
from mavfi_cli.core.seeds import Stream, generator
from mavfi_cli.core.types import Briefing
from mavfi_cli.fi.tracer import record
from mavfi_cli.fi.tracer.fault import InstructionFault
from mavfi_cli.mission.instruction.rehearsal import Order, count_entries, profile_invocation
from mavfi_cli.mission.instruction.server import Setup
from mavfi_cli.mission.recorder import Recorder
from mavfi_cli.spec.instruction import InstructionConfig
from mavfi_cli.spec.mission import MissionConfig

T = TypeVar("T")
CACHE = ".profiles"


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedFault:
    """One exact instruction-level fault of a mission.

    Attributes:
        node: the attacked node.
        order: number of the node's order in which the fault strikes, from 1.
        context: further entries of the record: kernel, invocation, simulated time, sampling.
        recorded: the repeated record; None for a drawn fault.
    """

    fault: InstructionFault
    node: str
    order: int
    context: Mapping[str, Any]
    recorded: Mapping[str, Any] | None = None


def plan_fault(
    config: MissionConfig,
    asked: InstructionConfig,
    out: Path,
    versions: Mapping[str, str],
    fly_golden: Callable[[MissionConfig, Path, Recorder], object],
) -> PlannedFault:
    """Draw the fault of a mission and a seed.

    Args:
        config: the mission.
        asked: the requested fault.
        out: the folder below which golden runs and profiles are kept.
        versions: versions of the libraries.
        fly_golden: function that flies a mission into a folder and records it.

    Raises:
        FaultError: the kernel is never entered, or cannot be attacked here.
    """
    strategy, node = asked.strategy(), asked.node()
    kernel = kernel_of_node(node, config.planner)
    golden = replace(config, fault=None, instruction=None, detector=None, isolate=())
    folder = out / CACHE / _key(golden, versions)

    def fly() -> tuple[Briefing, dict[str, list[Order]]]:
        """The briefing of the golden run, and the orders that it gave, by node."""
        recorder = Recorder()
        fly_golden(golden, folder, recorder)
        assert recorder.briefing is not None
        return recorder.briefing, recorder.orders

    briefing, all_orders = _kept(folder / "orders.pickle", fly)
    setup = Setup(config=golden, briefing=briefing, node=node)
    orders = all_orders.get(node, [])
    counts = _kept(folder / f"entries-{kernel}.pickle", lambda: count_entries(setup, orders))
    if not counts or not counts[-1]:
        raise FaultError(
            f"the golden flight never enters {kernel}, so nothing in it can be hit: choose another "
            "world, seed or node"
        )
    rng = generator(asked.seed, Stream.FAULT, "instruction")
    drawn = draw_invocation(node, counts, rng)
    profiling = generator(config.seed, Stream.FAULT, "profile", kernel, drawn.number)
    found: TargetProfile = _kept(
        folder / f"profile-{kernel}-{drawn.number}.pickle",
        lambda: profile_invocation(
            setup, orders[: drawn.order], drawn.entry, drawn.earlier, profiling
        ),
    )
    fault = found.draw(replace(strategy, whole_process=False), rng)
    context = {
        "node": node,
        "kernel": kernel,
        "invocation": drawn.number,
        "invocations": drawn.of,
        "node_invocation": drawn.order,
        "stamp_s": round(orders[drawn.order - 1][1], 9),
        "sampling": asked.sampling_name(),
        "windows": found.windows,
        "profiled_instructions": found.executed,
        "seed": asked.seed,
        "request": asked.to_dict(),
    }
    struck = replace(fault, corruption=None) if asked.null else fault
    return PlannedFault(fault=struck, node=node, order=drawn.order, context=context)


@dataclass(frozen=True, slots=True, kw_only=True)
class KernelInvocation:
    """One invocation of a kernel, and the entry with which it begins."""

    number: int  # number of the kernel's invocation, from 1
    of: int
    order: int  # number of the node's order that contains it, from 1
    entry: int  # number of the kernel's entry with which it begins, from 1
    earlier: int  # entries in the earlier orders


def draw_invocation(node: str, counts: Sequence[int], rng: np.random.Generator) -> KernelInvocation:
    """Draw one invocation of a kernel uniformly from the entries up to each order.

    Each entry is an invocation, except for a planner node. It is entered each time it builds an
    obstacle grid, once or more in a request, and the request is the invocation.

    Args:
        node: the node that runs the kernel.
        counts: entries up to each order of the golden run, ascending; not empty.
        rng: the random generator.
    """
    before = np.array([0, *counts[:-1]])
    if node != "planner":
        number = entry = int(rng.integers(counts[-1])) + 1
        order, of = int(np.searchsorted(counts, entry)), counts[-1]
    else:
        orders = np.flatnonzero(np.array(counts) > before)
        which, of = int(rng.integers(len(orders))), len(orders)
        order, number = int(orders[which]), which + 1
        entry = int(before[order]) + 1
    return KernelInvocation(
        number=number, of=of, order=order + 1, entry=entry, earlier=int(before[order])
    )


def planned_of(recorded: Mapping[str, Any]) -> PlannedFault:
    """Read the fault of a record, to repeat it.

    Raises:
        RecordError: not the record of an instruction-level fault in a mission.
    """
    fault = record.fault_of(recorded)
    try:
        context = {name: recorded[name] for name in _CONTEXT}
    except KeyError as error:
        raise RecordError(f"the fault record is damaged: it has no {error}") from None
    return PlannedFault(
        fault=fault,
        node=context["node"],
        order=context["node_invocation"],
        context=context,
        recorded=recorded,
    )


_CONTEXT = (
    "node", "kernel", "invocation", "invocations", "node_invocation", "stamp_s", "sampling",
    "windows", "profiled_instructions", "seed", "request",
)  # fmt: skip


def _kept(path: Path, make: Callable[[], T]) -> T:
    """Read a value from its file, or make it and keep it there."""
    if path.is_file():
        kept: T = pickle.loads(path.read_bytes())
        return kept
    value = make()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordError(f"{path.parent}: {error.strerror or error}") from None
    write_atomically(path, lambda file: pickle.dump(value, file))
    return value


def _key(golden: MissionConfig, versions: Mapping[str, str]) -> str:
    """A hash of everything that the golden run depends on."""
    values = golden.to_dict()
    files = [Path(name) for name in golden.files]
    parts = [
        json.dumps(values, sort_keys=True),
        json.dumps(dict(versions), sort_keys=True),
        own_digest(),
        *(hashlib.sha256(path.read_bytes()).hexdigest() for path in files if path.is_file()),
    ]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]
