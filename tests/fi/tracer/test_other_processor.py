"""What works where the injector does not know the processor, and what says that it does not."""

import subprocess
import sys

import pytest

ELSEWHERE = """
import platform
platform.machine = lambda: "aarch64"
"""


def elsewhere(code):
    """Run code in a process that takes this machine for another one."""
    return subprocess.run(
        [sys.executable, "-c", ELSEWHERE + code], capture_output=True, text=True, check=False
    )


@pytest.mark.slow
def test_missions_and_source_level_faults_need_no_tracer():
    done = elsewhere(
        "import mavfi_cli.mission.run, mavfi_cli.fi.tracer.sampling, mavfi_cli.attack.campaign\n"
        "from mavfi_cli.mission.machine import check_machine\n"
        "print([c.verdict for c in check_machine() if c.name == 'Tracing'])"
    )
    assert (done.stdout.strip(), done.stderr) == ("['limited']", "")


@pytest.mark.parametrize("use", ["Tracee.attach(os.getpid())", "ExecutionCounter(0, 0)"])
def test_using_it_says_which_machine_this_is(use):
    done = elsewhere(
        f"import os\nfrom mavfi_cli.fi.tracer.tracee import ExecutionCounter, Tracee\n"
        f"from mavfi_cli.core.errors import TracingForbidden\n"
        f"try:\n    {use}\nexcept TracingForbidden as error:\n    print(error)"
    )
    assert "this machine is aarch64" in done.stdout
