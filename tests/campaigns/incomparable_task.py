"""Real missions on a machine where the memory of rehearsed nodes cannot be compared."""

from mavfi_cli.campaigns import task
from mavfi_cli.core.errors import TargetError

prepare = task.prepare


def _refuse(*_forks):
    raise TargetError("node", "its memory cannot be read")


def perform(order, out, **options):
    from mavfi_cli.mission.instruction import rehearsal  # loads the tracer, which the server lacks

    rehearsal.remembers_the_same = _refuse
    return task.perform(order, out, **options)
