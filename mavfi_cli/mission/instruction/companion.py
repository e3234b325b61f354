"""An instruction-level fault in a process of a user's companion."""

from __future__ import annotations

import contextlib
import signal
import sys
from pathlib import Path
from typing import Any

from mavfi_cli.attack.live import LiveAttack, attack_moment, mission_strategy
from mavfi_cli.attack.tracer_thread import TracerThread
from mavfi_cli.companion.injection import Killer
from mavfi_cli.core.errors import MavfiError, described
from mavfi_cli.core.flight_record import NodeCrash, NodeEnds, Strike
from mavfi_cli.core.processes import Ended, EndWatch
from mavfi_cli.core.seeds import Stream
from mavfi_cli.fi.injector import Moment
from mavfi_cli.fi.tracer import linux, record, stepper
from mavfi_cli.fi.tracer.inject import NOTHING
from mavfi_cli.fi.tracer.record_fields import FaultRecord
from mavfi_cli.mission.companion_faults import CompanionFault
from mavfi_cli.mission.programs import RunningProgram
from mavfi_cli.spec.fault import InstructionConfig

# Signals with which programs end each other. If the struck process ends by such a signal, with code
# 0 or with unknown status, the fault counts as the cause only if the program still runs _WITHOUT_S
# later.
_ORDINARY = frozenset({signal.SIGTERM, signal.SIGINT, signal.SIGKILL, signal.SIGHUP})
_WITHOUT_S = 2.0
# The tracer thread computes in Python for up to several seconds. The link thread must not wait
# Python's default of 5 ms after every send or receive.
_SWITCH_S = 1e-4


class ProcessInjection(CompanionFault):
    """Injection of one instruction-level fault into a running program, by a tracer thread.

    Args:
        request: A fault that `check_companion_fault` accepts.
        repeat: Record of a fault whose instruction is to be struck again; None to draw one.

    Raises:
        TracingForbidden: The operating system does not permit tracing.
    """

    def __init__(self, request: InstructionConfig, repeat: FaultRecord | None) -> None:
        super().__init__()
        linux.require_permission()
        self._request, self._strategy, self._repeat = request, mission_strategy(request), repeat
        self._path: Path | None = None
        self._tracer: TracerThread[LiveAttack] | None = None
        self._context: dict[str, Any] = {}
        self._problem = ""
        self._reported = False
        self._usual_switch_s: float | None = None
        self._watch: EndWatch | None = None
        self._end: tuple[float, Ended] | None = None  # stamp and end of the struck process
        self._leads, self._codes = True, 0  # is it the program's own; number of earlier ends

    def aim_at(self, shortest_flight_s: float) -> None:
        """Draw the time of the fault, as described in `CompanionFault.aim_at`."""
        self._moment = Killer(self._request.moment(), shortest_flight_s, self._on_strike)
        self.injector = self._moment

    def begin(self, path: Path) -> None:
        """Write the record of the planned fault to `path`.

        Also load the code that cannot be loaded while a thread is stopped.
        """
        stepper.load()
        self._usual_switch_s = sys.getswitchinterval()
        sys.setswitchinterval(_SWITCH_S)
        self._path = path
        self._context = {
            "node": self._request.program,
            "kernel": self._request.executable or self._request.program,
            "sampling": self._strategy.name,
            "seed": self._request.seed,
            "request": self._request.as_dict(),
            "scope": list(self._request.objects),
        }
        record.write(path, record.undrawn(**self._context))

    def tick(self, moment: Moment) -> None:
        """Strike the program if the fault is due. Later, check whether the fault has ended it."""
        self.injector.strike(moment)
        if self._watch is None or self.ends:
            return
        program = self.running[self._request.program]
        if self._end is None and (ended := self._look(self._watch, program)) is not None:
            self._end = moment.stamp_s, ended
        if self._end is None:
            return
        stamp_s, ended = self._end
        failed = bool(ended.exit_code) or ended.signal not in {None, *_ORDINARY}
        if failed or (program.pid is not None and moment.stamp_s - stamp_s >= _WITHOUT_S):
            crash = NodeCrash(stamp_s=round(stamp_s, 9), how=ended.describe())
            self.ends = {self._request.program: NodeEnds(crashes=[crash])}

    def _look(self, watch: EndWatch, program: RunningProgram) -> Ended | None:
        """Return how the struck process ended, or None while that is unknown."""
        ended = watch.look()
        if ended is None or not self._leads or ended.exit_code is not None or ended.signal:
            return ended
        codes = program.codes[self._codes :]  # the program's own process: its worker has the status
        return Ended.of(codes[0]) if codes else None

    def close(self) -> None:
        """Stop watching the struck process, and restore Python's thread switch interval."""
        if self._watch is not None:
            self._watch.close()
            self._watch = None
        if self._usual_switch_s is not None:
            sys.setswitchinterval(self._usual_switch_s)

    def _on_strike(self, strike: Strike) -> None:
        program, path, request = self.running.get(self._request.program), self._path, self._request
        assert path is not None
        self._context["stamp_s"] = round(strike.stamp_s, 9)
        pid = None if program is None else program.process(request.executable)
        try:
            if program is None or pid is None:
                raise ProcessLookupError
            self._watch = EndWatch(pid)
            self._leads, self._codes = pid == program.pid, len(program.codes)
        except ProcessLookupError:
            wanted = request.executable or request.program
            self._problem = f"no process of {wanted} ran at the moment of the fault"
            return
        rng = Stream.FAULT.generator(request.seed, "instruction")
        self._tracer = TracerThread(
            lambda _armed: attack_moment(
                pid, self._strategy, rng, path=path, objects=request.objects,
                function=request.function, null=request.null, repeat=self._repeat, **self._context,
            )
        )  # fmt: skip

    def news(self) -> list[str]:
        """Return a description of the fault, once, after the tracer has finished."""
        if self._reported or self._tracer is None or not self._tracer.done:
            return []
        self._reported = True
        return [record.describe(self._written())]

    def finish(self) -> dict[str, Any]:
        """Return the fault's record. Call it only after the programs have ended.

        Only now are the symbols of the struck object read, because that would hold up the link.
        """
        written = self._written()
        if symbol := self._symbol():
            written["symbol"] = symbol
            assert self._path is not None
            record.write(self._path, written)
        if not (written.get("injection") or {}).get("applied") or self._ended_as_usual():
            self.ends = {}  # the process ended by itself
        return record.repeatable(written)

    def _ended_as_usual(self) -> bool:
        """Return True if a process's exit code was no failure to the program that started it."""
        program = self.running.get(self._request.program)
        fine = program is not None and program.codes[-1:] == [0]
        code = None if self._end is None else self._end[1].exit_code
        return fine and not self._leads and code is not None

    def _symbol(self) -> str:
        with contextlib.suppress(MavfiError, OSError):
            return "" if self._tracer is None else self._tracer.result().name_symbol()
        return ""

    def _written(self) -> FaultRecord:
        reason = self._problem or self._moment.missed
        if self._tracer is not None:
            try:
                return self._tracer.result().record
            except MavfiError as error:
                reason = str(error)
            except OSError as error:  # the process ended before it was traced
                reason = described(error)
        undrawn = record.undrawn(**self._context)
        nothing = record.completed(undrawn, None, NOTHING, not_injected_reason=reason)
        assert self._path is not None
        record.write(self._path, nothing)
        return nothing
