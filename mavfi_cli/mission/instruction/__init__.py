"""Instruction-level faults in a mission: planning, profiling, injection, and the attacked node."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

from mavfi_cli.core.compiled import own_digest
from mavfi_cli.core.files import file_digest
from mavfi_cli.core.installed import installed_versions
from mavfi_cli.spec.mission import MissionConfig

PROGRAM = "mavfi_cli.mission.instruction.server"  # program of the attacked node
CACHE = ".profiles"  # subfolder of the runs' folder


def kept_in(folder: Path, golden: MissionConfig) -> Path:
    """Return the subfolder of `folder` that keeps a golden mission's requests and profiles.

    The subfolder's name is a hash of everything that determines the golden run.
    """
    parts = [
        json.dumps(golden.to_dict(), sort_keys=True),
        json.dumps(installed_versions(), sort_keys=True),
        own_digest(),
        *(digest for name in golden.files if (digest := file_digest(name))),
    ]
    return folder / hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]
