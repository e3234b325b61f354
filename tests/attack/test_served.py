"""A served program: one that was started early belongs to the next that needs it."""

import pytest

from mavfi_cli.attack import served
from mavfi_cli.attack.served import served_process, start_early

MODULE = "mavfi_cli.attack.kernels.template"


@pytest.fixture
def started(monkeypatch):
    """The programs in the order of their start."""
    programs = []

    class Noted(served.ServedProcess):
        def __init__(self, module):
            super().__init__(module)
            programs.append(self)

    monkeypatch.setattr(served, "ServedProcess", Noted)
    yield programs
    for each in programs:
        each.kill()


def test_a_program_that_was_started_early_is_taken_once(started):
    start_early(MODULE)
    start_early(MODULE)  # it runs already
    assert len(started) == 1
    assert [served_process(MODULE), served_process(MODULE)] == started
    assert len({each.pid for each in started}) == 2
