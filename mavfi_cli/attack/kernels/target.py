"""One kernel as a target: a template process that forks itself for every run.

This is the attacker's side of `attack.kernels.template`. It starts a run, which is stopped at
first, then reads the run's output and judges it with the kernel's own comparison.
"""

from __future__ import annotations

import contextlib
import copy
import math
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mavfi_cli.attack.attacker import run_out
from mavfi_cli.attack.comparison import Difference
from mavfi_cli.attack.kernels import catalogue
from mavfi_cli.attack.kernels.catalogue import unpack
from mavfi_cli.attack.kernels.inputs import read_inputs
from mavfi_cli.attack.kernels.scope import KernelScope
from mavfi_cli.attack.kernels.template import ASK_SCOPE, GO, PID_BYTES, RAISED, RUN, TIMES
from mavfi_cli.attack.place import Golden, Watch, digest
from mavfi_cli.attack.profile import TargetProfile, profile_run
from mavfi_cli.attack.served import ServedProcess
from mavfi_cli.attack.target import RunLimits, RunOutcome, RunVerdict, judged
from mavfi_cli.core.compiled import own_digest
from mavfi_cli.core.errors import FaultError, TargetError
from mavfi_cli.core.files import Json
from mavfi_cli.core.processes import Ended, receive
from mavfi_cli.fi.tracer.image import Image, Scope
from mavfi_cli.fi.tracer.tracee import Mechanism, Tracee

_PROGRAM = "mavfi_cli.attack.kernels.template"


@dataclass(frozen=True, slots=True, kw_only=True)
class KernelTarget:
    """A kernel to attack, and its inputs.

    Attributes:
        kernel: name of a built-in kernel, or the file of a user's kernel.
        inputs: file with inputs of one flight, which `flight` describes.
        tolerance: largest relative error of an output that still counts as benign.
    """

    kernel: str
    inputs: Path
    inputs_sha256: str = ""
    flight: str = ""
    tolerance: float = 0.0
    mechanism: Mechanism | None = None

    @property
    def name(self) -> str:
        """The kernel's name."""
        return catalogue.find(self.kernel).name

    @property
    def stream(self) -> tuple[str, ...]:
        """Name of the kernel's random stream, so that its faults do not depend on other kernels."""
        return (self.name,)

    def settings(self) -> Json:
        """Return all settings that determine the results of the kernel's runs."""
        return {
            "inputs_sha256": self.inputs_sha256,
            "flight": self.flight,
            "tolerance": self.tolerance,
            "memory_mb": catalogue.find(self.kernel).memory_mb,
            "sources": own_digest(),
        }

    def open(self) -> _KernelPlace:
        """Start the kernel's template process, and return the place for its runs."""
        return _KernelPlace(self)


class _KernelPlace:
    """Runs one kernel in forks of one template; use it only in the thread that created it.

    Attributes:
        inputs: one place per input of the kernel. All share one template, which belongs to the
            first.
    """

    kind = "kernel"

    def __init__(self, target: KernelTarget) -> None:
        """Start the template.

        Raises:
            RecordError: the inputs cannot be read.
            TargetError: the kernel cannot be loaded.
        """
        self.name, self._kernel = target.name, catalogue.find(target.kernel)
        self.limits, inputs = RunLimits(cpu_grace_s=self._kernel.hang_s), read_inputs(target.inputs)
        with contextlib.ExitStack() as undo:
            self._output = os.memfd_create("mavfi-kernel-output")
            undo.callback(os.close, self._output)
            self._template = ServedProcess(_PROGRAM, output=self._output)
            undo.callback(self._template.kill)
            count = self._template.begin((target.kernel, inputs), self.name)
            self.kernel_scope = self._find_scope()
            self._image = Image(self._template.pid, self.kernel_scope.regions)
            self.close = undo.pop_all().close
        self._target, self._number = target, 0
        self.inputs = [self]
        while len(self.inputs) < count:
            self.inputs.append(copy.copy(self))
            self.inputs[-1]._number = len(self.inputs) - 1

    def _find_scope(self) -> KernelScope:
        self._template.connection.send(ASK_SCOPE)
        try:
            scope: KernelScope = receive(self._template.connection)
        except (OSError, EOFError):
            words = self._template.last_error()
            raise TargetError(self.name, f"cannot be attacked: {words}") from None
        return scope

    def start(self) -> Tracee:
        """Fork the template for one run, and stop the fork before it calls the kernel.

        Raises:
            TracingForbidden: the operating system does not allow tracing.
            FaultError: the template process has ended.
        """
        control = self._template.connection
        os.ftruncate(self._output, 0)
        control.send(RUN + bytes([self._number]))
        packet = control.recv(PID_BYTES)
        if len(packet) < PID_BYTES:
            raise FaultError(f"the template process of {self.name} ended unexpectedly")
        tracee = Tracee.attach(int.from_bytes(packet, "little"), mechanism=self._target.mechanism)
        control.send(GO)
        return tracee

    def image(self, _: Tracee) -> Image:
        return self._image

    def scope(self, image: Image) -> Scope:
        return image.scope(self.kernel_scope.objects)

    def context(self) -> Json:
        objects = list(self.kernel_scope.objects)
        return {"scope": objects, "inputs_sha256": self._target.inputs_sha256}

    def profile(
        self, rng: np.random.Generator, *, windows: int, watch: Watch | None = None
    ) -> TargetProfile:
        """Step a golden run of the kernel, or a sample of its windows if the kernel is too long.

        The windows are divided among the inputs, because each input is one part of the campaign.

        Raises:
            TargetError: the kernel never enters its native code.
            WindowTooLong: a window has too many instructions.
        """
        scope = self.kernel_scope
        return profile_run(
            self,
            rng,
            markers=(scope.inner or (scope.entry,)) if self._kernel.too_long else (),
            end=scope.end,
            windows=max(4, windows // len(self.inputs)),
            limit=self.limits.profile_steps,
            watch=watch,
            reads_own_code=False,
        )

    def fault_free(self) -> Golden:
        """Run the kernel once without a fault.

        Raises:
            TargetError: the run fails.
        """
        ended = run_out(self.start())
        output = self.left()
        if output is None or ended.exit_code != 0:
            how = f"signal {ended.signal}" if ended.signal else f"exit code {ended.exit_code}"
            text = output.output.decode(errors="replace") if output else how
            raise TargetError(self.name, f"fails without a fault: {text}")
        return output

    def describe_difference(self, golden: Golden, again: Golden) -> str:
        return "" if golden.output == again.output else "their outputs differ"

    def left(self) -> Golden | None:
        """Return the times of the last run, and its output or the text of its error.

        Returns None if they are incomplete.
        """
        data = os.pread(self._output, os.fstat(self._output).st_size, 0)
        if len(data) < TIMES.size:
            return None
        cpu_s, wall_s = TIMES.unpack_from(data)
        return Golden(output=data[TIMES.size :], cpu_s=cpu_s, wall_s=wall_s)

    def judge(self, golden: Golden, ended: Ended | None) -> RunVerdict:
        run = None if ended is None else self.left()
        left = None if run is None else run.output
        tolerance = self._target.tolerance or None
        outcome, difference = judged(golden, ended, left, self._compare, tolerance=tolerance)
        raised = left is not None and ended is not None and ended.exit_code == RAISED
        size = 0.0 if difference is None else difference.relative
        return RunVerdict(
            outcome=outcome,
            output_sha256=digest(left) if left else "",
            details={
                "error": left.decode(errors="replace") if raised and left is not None else "",
                "magnitude": None if difference is None else difference.to_json(),
                "within_tolerance": outcome is RunOutcome.BENIGN and size > 0.0,
            },
        )

    def _compare(self, golden: bytes, output: bytes) -> Difference:
        try:
            return self._kernel.compare(unpack(golden), unpack(output))
        except (ValueError, KeyError) as damage:
            text = f"unreadable: {damage}"
            return Difference(relative=math.inf, absolute=math.inf, text=text)
