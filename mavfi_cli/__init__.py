"""mavfi: what a bit flip does to a flying robot, and what it costs to survive it.

The library is used as `import mavfi_cli as mavfi`. Its names are imported when they are first used,
so that the import itself and `mavfi --help` stay fast. docs/how-to/python.md shows how to use them.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mavfi_cli.campaigns.missions import PlannedMission
    from mavfi_cli.campaigns.run import run_campaign
    from mavfi_cli.core.errors import MavfiError
    from mavfi_cli.core.installed import __version__
    from mavfi_cli.fi.fault import inject
    from mavfi_cli.library import campaign, fly
    from mavfi_cli.mission.run import paired_golden
    from mavfi_cli.mission.run_folder import load_run
    from mavfi_cli.spec.detector import DetectorConfig
    from mavfi_cli.spec.fault import FaultConfig, InstructionConfig
    from mavfi_cli.spec.mission import MissionConfig

__all__ = [
    "DetectorConfig",
    "FaultConfig",
    "InstructionConfig",
    "MavfiError",
    "MissionConfig",
    "PlannedMission",
    "__version__",
    "campaign",
    "fly",
    "inject",
    "load_run",
    "paired_golden",
    "run_campaign",
]

_MODULES = {  # name -> module that defines it
    "DetectorConfig": "mavfi_cli.spec.detector",
    "FaultConfig": "mavfi_cli.spec.fault",
    "InstructionConfig": "mavfi_cli.spec.fault",
    "MavfiError": "mavfi_cli.core.errors",
    "MissionConfig": "mavfi_cli.spec.mission",
    "PlannedMission": "mavfi_cli.campaigns.missions",
    "__version__": "mavfi_cli.core.installed",
    "campaign": "mavfi_cli.library",
    "fly": "mavfi_cli.library",
    "inject": "mavfi_cli.fi.fault",
    "load_run": "mavfi_cli.library",  # also lets notebooks display runs
    "paired_golden": "mavfi_cli.mission.run",
    "run_campaign": "mavfi_cli.campaigns.run",
}


def __getattr__(name: str) -> Any:
    """Import a public name of the library when it is first accessed, and cache it."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the names defined in this module and the public names, imported or not."""
    return sorted({*globals(), *__all__})
