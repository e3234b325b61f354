"""Ensures that all missions of a campaign fly with the same versions and the same user files."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path

from mavfi_cli.campaign.ledger import Ledger
from mavfi_cli.campaign.missions import PlannedMission, canonical
from mavfi_cli.core.errors import ConfigError
from mavfi_cli.mission.replay import version_differences
from mavfi_cli.mission.run import installed_versions

_VERSIONS, _FILES = "versions", "files"  # keys of the ledger's `meta`


def require_unchanged(ledger: Ledger) -> None:
    """Require that versions and files are those with which the campaign was begun.

    Raises:
        ConfigError: the campaign was begun with others; names them.
    """
    versions = installed_versions()
    stored = ledger.meta(_VERSIONS)
    if stored is None:
        ledger.set_meta({_VERSIONS: canonical(versions)})
    elif stored != canonical(versions):
        differing = version_differences(json.loads(stored), versions)
        raise ConfigError(f"begun with other versions: {'; '.join(differing)}", path=ledger.folder)
    changed = [name for name, digest in _noted(ledger).items() if digest != _digest(name)]
    if changed:
        raise ConfigError(
            f"{', '.join(changed)}: not as it was when the campaign was begun; "
            "another folder starts anew",
            path=ledger.folder,
        )


def note_files(ledger: Ledger, missions: Iterable[PlannedMission]) -> None:
    """Store hashes of the files that missions name, for `require_unchanged`."""
    noted = _noted(ledger)
    named = {name for mission in missions for name in mission.config.files}
    new = {name: _digest(name) for name in sorted(named - noted.keys())}
    if new:
        ledger.set_meta({_FILES: canonical({**noted, **new})})


def _noted(ledger: Ledger) -> dict[str, str]:
    found: dict[str, str] = json.loads(ledger.meta(_FILES) or "{}")
    return found


def _digest(name: str) -> str:
    """Hash of a file's bytes; empty if there is no file."""
    try:
        return hashlib.sha256(Path(name).read_bytes()).hexdigest()
    except OSError:
        return ""
