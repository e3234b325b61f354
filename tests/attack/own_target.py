"""A target of one's own in one file: a program whose last digit does not matter."""

from dataclasses import dataclass
from pathlib import Path

from mavfi_cli.attack.attacker import run_out
from mavfi_cli.attack.place import Golden, digest
from mavfi_cli.attack.profile import profile_run
from mavfi_cli.attack.target import RunLimits, RunVerdict, judged
from mavfi_cli.fi.tracer.image import Image
from mavfi_cli.fi.tracer.spawn import Program, run_to_entry, spawn


@dataclass(frozen=True, kw_only=True)
class OwnTarget:
    """Plain values: a worker process gets a copy and opens it."""

    program: Path
    scratch: Path
    name = "own"
    stream = ()

    def settings(self):
        return {"program": str(self.program)}

    def open(self):
        return OwnPlace(self)


class OwnPlace:
    kind = "program"
    limits = RunLimits(cpu_grace_s=0.1, wall_grace_s=3.0)

    def __init__(self, target):
        self.target, self.name = target, target.name
        self._command = Program.of([str(target.program), "30"])
        self._output = target.scratch / f"output-{id(self)}"

    def start(self):
        tracee = spawn(self._command, stdout=self._output, stderr=Path("/dev/null"))
        assert run_to_entry(tracee)
        return tracee

    def image(self, tracee):
        return Image(tracee.pid)

    def scope(self, image):
        return image.scope([self.target.program.name])

    def context(self):
        return {"program": [str(self.target.program)]}

    def profile(self, rng, *, windows, watch):
        return profile_run(self, rng, watch=watch)

    def fault_free(self):
        ended = run_out(self.start())
        return Golden(output=self._left(), exit_code=ended.exit_code, cpu_s=0.01, wall_s=0.01)

    def describe_difference(self, golden, again):
        return "" if golden.output == again.output else "their outputs differ"

    def judge(self, golden, ended):
        output = self._left()
        outcome, _ = judged(golden, ended, output, lambda *_: None, tolerance=None)
        return RunVerdict(
            outcome=outcome, output_sha256=digest(output), details={"magnitude": None}
        )

    def _left(self):
        return self._output.read_bytes()[:-2]

    def close(self):
        self._output.unlink(missing_ok=True)
