"""From what a user asks for to one exact instruction-level fault of a mission.

What the golden flight asked of each node, how often each kernel was entered, and each profile
are kept below the output folder, by everything that they depend on.
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
from mavfi_cli.core.files import write_atomically
from mavfi_cli.core.seeds import Stream, generator
from mavfi_cli.core.sources import own_digest
from mavfi_cli.fi.tracer import record
from mavfi_cli.fi.tracer.fault import InstructionFault
from mavfi_cli.mission.briefing import Briefing
from mavfi_cli.mission.config import MissionConfig
from mavfi_cli.mission.instruction.rehearsal import Order, count_entries, profile_invocation
from mavfi_cli.mission.instruction.server import Setup
from mavfi_cli.mission.instruction_config import InstructionConfig
from mavfi_cli.mission.orders import Recorder

T = TypeVar("T")
CACHE = ".profiles"


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedFault:
    """One exact fault.

    Attributes:
        node: the attacked node.
        order: in which of its invocations the fault strikes, from 1.
        context: what else the record says: kernel, invocation, simulated time, sampling.
        recorded: the record that is repeated; None for a fault that was drawn.
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
    """Draw the fault that a mission and a seed stand for.

    Args:
        config: the mission.
        asked: what is to be injected.
        out: the folder below which golden flight and profiles are kept.
        versions: of the libraries.
        fly_golden: flies a mission into a folder and records it.

    Raises:
        FaultError: the kernel is never entered, or cannot be attacked here.
    """
    strategy, node = asked.strategy(), asked.node()
    kernel = kernel_of_node(node, config.planner)
    golden = replace(config, fault=None, instruction=None, detector=None, isolate=())
    folder = out / CACHE / _key(golden, versions)

    def fly() -> tuple[Briefing, dict[str, list[Order]]]:
        """The briefing of the golden flight, and what it asked of its nodes, by node."""
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
class Invocation:
    """One invocation of a kernel, and how it is reached."""

    number: int  # of the kernel, from 1
    of: int
    order: int  # of the node, from 1, in which it happens
    entry: int  # of the kernel, from 1, with which it begins
    earlier: int  # entries in the orders before


def draw_invocation(node: str, counts: Sequence[int], rng: np.random.Generator) -> Invocation:
    """One invocation of a kernel, uniformly, from how often it was entered up to each order.

    Each entry is an invocation. A planner node is entered once or more in a request (each time it
    builds an obstacle grid), and the request is the invocation.

    Args:
        node: whose kernel it is.
        counts: entries up to each order of the golden flight, ascending; some.
        rng: draws.
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
    return Invocation(
        number=number, of=of, order=order + 1, entry=entry, earlier=int(before[order])
    )


def planned_of(recorded: Mapping[str, Any]) -> PlannedFault:
    """The fault of a record, to repeat it.

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
    """A value from its file, or made and kept there."""
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
    """A name for all that the golden flight depends on."""
    values = golden.to_dict()
    files = [Path(name) for name in golden.files]
    parts = [
        json.dumps(values, sort_keys=True),
        json.dumps(dict(versions), sort_keys=True),
        own_digest(),
        *(hashlib.sha256(path.read_bytes()).hexdigest() for path in files if path.is_file()),
    ]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]
