"""Injects an instruction-level fault into a mission from a tracer thread beside the flight."""

from __future__ import annotations

import signal
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from mavfi_cli.attack.attacker import LiveAttack, attack_live
from mavfi_cli.attack.kernels.scope import KernelScope
from mavfi_cli.attack.served import ServedProcess
from mavfi_cli.companion.executor import Executor
from mavfi_cli.companion.injection import SCHEMA, NoInjection
from mavfi_cli.companion.node_process import NodeProcess
from mavfi_cli.core.errors import FaultError
from mavfi_cli.core.types import Briefing
from mavfi_cli.fi.tracer import record
from mavfi_cli.fi.tracer.image import Image
from mavfi_cli.fi.tracer.thread import TracerThread
from mavfi_cli.mission.instruction.plan import PlannedFault, plan_fault, planned_of
from mavfi_cli.mission.instruction.server import PROGRAM, Setup
from mavfi_cli.mission.recorder import Recorder
from mavfi_cli.spec.mission import MissionConfig

_TIMING = ("stop_s",)


class InstructionInjection(NoInjection):
    """One instruction-level fault in one mission; messages pass unchanged.

    Args:
        planned: the planned fault.
        spawned: the process that will be the attacked node.
        for_debugger: called when the node waits for a debugger at the injected instruction.
    """

    def __init__(
        self,
        planned: PlannedFault,
        spawned: ServedProcess,
        for_debugger: Callable[[int], None] | None = None,
    ) -> None:
        super().__init__()
        self._planned = planned
        self._spawned = spawned
        self._for_debugger = for_debugger
        self._path: Path | None = None
        self._tracer: TracerThread[LiveAttack] | None = None
        self._told = False
        self._finished: Callable[[], int] = lambda: 0

    @property
    def node(self) -> str:
        """The attacked node."""
        return self._planned.node

    def begin(self, path: Path) -> None:
        """Set the path of the record."""
        self._path = path

    def arm(self, executor: Executor, config: MissionConfig, briefing: Briefing) -> None:
        """Move the attacked node into its own process and arm the fault there.

        Raises:
            BuildMismatch: the repeated record is of another build.
            TracingForbidden: the operating system refuses.
        """
        scope = self._spawned.begin(
            Setup(config=config, briefing=briefing, node=self.node), f"node {self.node}"
        )
        self._finished = lambda: executor.nodes[self.node].finished
        pid = self._spawned.pid
        if self._planned.recorded is not None:
            record.require_same_build(self._planned.recorded, Image(pid, scope.regions))
        self._tracer = TracerThread(lambda armed: self._attack(pid, scope, armed))
        self._tracer.await_armed()
        process = NodeProcess(
            self._spawned.connection,
            pid,
            ending=self._ending,
            patient=self._for_debugger is not None,
        )
        executor.isolate(self.node, process)

    def _attack(self, pid: int, scope: KernelScope, armed: Callable[[], None]) -> LiveAttack:
        assert self._path is not None
        debugging = self._for_debugger is not None
        done = attack_live(
            pid,
            self._planned.fault,
            path=self._path,
            regions=scope.regions,
            window=0 if debugging else 64,
            armed=armed,
            leave_stopped=debugging,
            scope=list(scope.objects),
            **self._planned.context,
        )
        if self._for_debugger is not None and done.ended is None:
            self._for_debugger(pid)
        return done

    def _ending(self) -> str | None:
        """How the node ended, if the tracer was told."""
        if self._tracer is None:
            return None
        ended = self._tracer.result().ended
        if ended is None:
            return None
        if ended.signal is not None:
            return f"killed by {signal.Signals(ended.signal).name}"
        return f"ended with code {ended.exit_code}"

    def news(self) -> list[str]:
        """The fault as text, once the struck invocation is over."""
        if self._told or self._tracer is None or self._finished() < self._planned.order:
            return []
        self._told = True
        done = self._tracer.result()
        if self._planned.fault.corruption is None:
            return []
        return [attack_text(done.record)]

    def finish(self) -> dict[str, Any] | None:
        """The record at the end of the mission, without measured times."""
        if self._tracer is None:
            self._spawned.kill()
            return None
        return in_result(self._tracer.result().record)

    def close(self) -> None:
        """End the node's process if no executor owns it."""
        if self._tracer is None:
            self._spawned.kill()


def in_result(written: Mapping[str, Any]) -> dict[str, Any]:
    """A fault record as result.json carries it: the same in every repetition."""
    injection = {k: v for k, v in written["injection"].items() if k not in _TIMING}
    state = "applied" if injection["applied"] else "not_injected"
    if written["corruption"] is None and not written.get("not_injected_reason"):
        state = "null"
    reason = written.get("not_injected_reason", "")
    return {**written, "schema": SCHEMA, "state": state, "reason": reason, "injection": injection}


def attack_text(written: Mapping[str, Any]) -> str:
    """One line that says what was hit."""
    place = written["symbol"] or f"{written['object']}+{written['offset']:#x}"
    where = f"{written['kernel']}, {written['instruction']} at {place}"
    if not written["injection"]["applied"]:
        return f"fault in {where}: not injected ({written.get('not_injected_reason', '')})"
    corruption = written["corruption"]
    bits = ", ".join(map(str, corruption["bits"]))
    what = corruption["register"] or corruption["site"]
    activation = written["activation"]["activation"].replace("_", " ")
    return f"fault in {where}: bit {bits} of {corruption['role']} {what}, {activation}"


def injection_of(
    config: MissionConfig,
    out: Path,
    versions: Mapping[str, str],
    fly_golden: Callable[[MissionConfig, Path, Recorder], object],
    *,
    repeat: Mapping[str, Any] | None = None,
    for_debugger: Callable[[int], None] | None = None,
) -> InstructionInjection:
    """Plan the instruction-level fault of a mission, and start its node's process.

    Args:
        config: the mission.
        out: the folder below which golden runs and profiles are kept.
        versions: versions of the libraries.
        fly_golden: function that flies a mission into a folder and records it.
        repeat: the record of a fault to repeat; None draws one.
        for_debugger: called when the node waits for a debugger at the injected instruction.

    Raises:
        FaultError: the flight is not repeatable, or nothing can be hit in it.
    """
    assert config.instruction is not None
    if config.link is not None:
        raise FaultError(
            "an instruction-level fault is drawn from the golden flight, and a foreign autopilot "
            "flies no two alike: leave out --link"
        )
    if repeat is not None:
        planned = planned_of(repeat)
    else:
        planned = plan_fault(config, config.instruction, out, versions, fly_golden)
    return InstructionInjection(planned, ServedProcess(PROGRAM), for_debugger)
