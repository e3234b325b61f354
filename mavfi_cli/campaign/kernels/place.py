"""The attacker's side of a template: start a run, stopped; take its output afterwards."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import pickle
import signal
import socket
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from mavfi_cli.campaign.kernels.template import ASK_SCOPE, GO, LENGTH_BYTES, PID_BYTES, RUN, TIMES
from mavfi_cli.core.errors import FaultError, RecordError, TargetError
from mavfi_cli.fi.native import linux
from mavfi_cli.fi.native.breakpoints import Mechanism
from mavfi_cli.fi.native.image import Image, Scope, scope_of
from mavfi_cli.fi.native.tracee import Tracee
from mavfi_cli.mission.instruction.scope import KernelScope

# Nothing else of the environment reaches a run, so that its memory does not depend on the shell.
_KEPT = ("HOME", "PATH", "LANG", "NUMBA_CACHE_DIR", "VIRTUAL_ENV")
_FIXED = {
    "PYTHONHASHSEED": "0",
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MALLOC_ARENA_MAX": "1",
}


# Only `load` leaves bytecode behind, whatever the user's own setting is.
_NO_BYTECODE = {"PYTHONDONTWRITEBYTECODE": "1"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Template:
    """How a template is started.

    Command line, environment and folder are the same whoever starts it, wherever the inputs lie:
    their lengths alone would move its stack and its heap.
    """

    arguments: tuple[str, ...]  # what follows `python`
    data: bytes  # sent to it first


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """Where everything is in the memory of a kernel's runs; the same in every template."""

    scope: KernelScope
    image: Image
    digest: str  # of the addresses of all code


@dataclass(frozen=True, slots=True, kw_only=True)
class Told:
    """What a run left: the times of its call, and its packed output or its error."""

    cpu_s: float
    wall_s: float
    data: bytes


class Place:
    """One template of a kernel with its output file; belongs to the thread that made it."""

    kind = "kernel"

    def __init__(
        self,
        name: str,
        template: Template,
        *,
        layout: Layout | None = None,
        mechanism: Mechanism | None = None,
        look_up: bool = True,
        fill_caches: bool = False,
    ) -> None:
        """Start the template.

        Args:
            name: of the kernel.
            template: how its process is started.
            layout: of another template of the same kernel; looking it up takes seconds.
            mechanism: how executions are counted.
            look_up: find the layout; without it nothing can be attacked.
            fill_caches: keep the bytecode of what it imports.

        Raises:
            TargetError: the kernel cannot be loaded.
        """
        self.name = name
        self._mechanism = mechanism
        self._output = os.memfd_create("mavfi-kernel-output", 0)
        self._control, theirs = socket.socketpair()
        self._errors = os.memfd_create("mavfi-kernel-errors", 0)
        environment = {name: os.environ[name] for name in _KEPT if name in os.environ} | _FIXED
        if not fill_caches:
            environment |= _NO_BYTECODE
        with theirs, linux.fixed_addresses():
            self._process = subprocess.Popen(
                [sys.executable, *template.arguments],
                stdin=theirs.fileno(),
                stdout=self._output,
                stderr=self._errors,
                env=environment,
                cwd="/",
                start_new_session=True,
            )
        with contextlib.ExitStack() as undo:
            undo.callback(self.close)
            self._control.sendall(len(template.data).to_bytes(LENGTH_BYTES, "little"))
            self._control.sendall(template.data)
            self._receive(1)
            if look_up:
                self.layout = self._layout(layout)
            undo.pop_all()

    def _layout(self, known: Layout | None) -> Layout:
        if known is not None and known.digest == _digest(self._process.pid):
            return known
        self._control.send(ASK_SCOPE)
        size = int.from_bytes(self._receive(LENGTH_BYTES), "little")
        scope: KernelScope = pickle.loads(self._receive(size))
        pid = self._process.pid
        return Layout(scope=scope, image=Image(pid, scope.regions), digest=_digest(pid))

    def _receive(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            piece = self._control.recv(size - len(data))
            if not piece:
                raise TargetError(self.name, f"does not load: {self._last_words()}")
            data += piece
        return data

    def _last_words(self) -> str:
        said = os.pread(self._errors, 1 << 20, 0).decode(errors="replace").strip().splitlines()
        return said[-1] if said else "its process ended"

    def start(self) -> Tracee:
        """A fresh run, attached and stopped, that has not called the kernel yet.

        Raises:
            TracingForbidden: the operating system refuses.
            FaultError: the template has died.
        """
        os.ftruncate(self._output, 0)
        self._control.send(RUN)
        told = self._control.recv(PID_BYTES)
        if len(told) < PID_BYTES:
            raise FaultError(f"the process that loads {self.name} has died")
        tracee = Tracee.attach(int.from_bytes(told, "little"), mechanism=self._mechanism)
        self._control.send(GO)
        return tracee

    def image(self, _: Tracee) -> Image:
        """What a run has in its memory: the same in all."""
        return self.layout.image

    def scope(self, image: Image) -> Scope:
        """The code that may be hit."""
        return scope_of(image, self.layout.scope.objects)

    def told(self) -> Told | None:
        """What the run that has ended left; None where it left nothing whole."""
        data = os.pread(self._output, os.fstat(self._output).st_size, 0)
        if len(data) < TIMES.size:
            return None
        cpu_s, wall_s = TIMES.unpack_from(data)
        return Told(cpu_s=cpu_s, wall_s=wall_s, data=data[TIMES.size :])

    def close(self) -> None:
        """End the template."""
        self._control.close()
        with contextlib.suppress(ProcessLookupError):
            os.kill(self._process.pid, signal.SIGKILL)
        self._process.wait()
        os.close(self._errors)
        os.close(self._output)


def template_of(kernel: str, inputs: Path) -> Template:
    """The template of one of our own kernels.

    Raises:
        RecordError: the inputs cannot be read.
    """
    try:
        data = inputs.read_bytes()
    except OSError as error:
        raise RecordError(f"{inputs}: {error.strerror}") from None
    return Template(arguments=("-m", "mavfi_cli.campaign.kernels.template", kernel), data=data)


@functools.cache
def load(kernel: str, template: Template) -> None:
    """Load a kernel once, so that all its compiled code is in the cache from now on.

    So is the bytecode of all that it imports: a process that compiles modules has another memory
    than one that finds them compiled.
    """
    Place(kernel, template, look_up=False, fill_caches=True).close()


def _digest(pid: int) -> str:
    """Of the addresses of everything executable in a process."""
    maps = Path(f"/proc/{pid}/maps").read_text().splitlines()
    code = [line.split() for line in maps if "x" in line.split()[1]]
    known = [f"{part[0]} {part[2]} {part[-1]}" for part in code]
    return hashlib.sha256("\n".join(known).encode()).hexdigest()
