"""`mavfi vpm --overhead`: per cent as given, or measured in flights that are on disk."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import click

from mavfi_cli.core.errors import RecordError
from mavfi_cli.vpm.overhead import overheads_of
from mavfi_cli.vpm.schemes import DETECTORS

_LEDGER, _RESULT = "ledger.sqlite", "result.json"
# Where ledgers lie below: a campaign, an evaluation of detectors, flights of `mavfi vpm --fly`.
_LEDGERS = (_LEDGER, f"protected/*/{_LEDGER}", f"flights/{_LEDGER}")


def overheads(texts: tuple[str, ...], platform: str | None = None) -> dict[str, tuple[float, str]]:
    """Per cent and source of each detector; the last word counts.

    Args:
        platform: that is modelled; flights on others do not count. None: all count.

    Raises:
        click.UsageError: neither DETECTOR=PERCENT nor a path.
        RecordError: a path without flights with a detector on the platform.
    """
    found: dict[str, tuple[float, str]] = {}
    for text in texts:
        name, _, number = text.partition("=")
        if Path(text).exists():
            found |= measured(text, platform)
            continue
        try:
            found[name.strip()] = float(number), "--overhead"
        except ValueError:
            raise click.UsageError(
                f"--overhead {text}: no such file or folder; for per cent write aad=0.0062"
            ) from None
    return found


def measured(text: str, platform: str | None = None) -> dict[str, tuple[float, str]]:
    """The overheads of the error-free flights with a detector that lie at a path.

    Args:
        platform: only flights on this one count; None: all.

    Raises:
        RecordError: there are none; says what is there.
    """
    path = Path(text)
    of_each = overheads_of(_results(path), platform)
    known = {name: each for name, each in of_each.items() if name in DETECTORS}
    if not known and platform is not None:
        elsewhere = overheads_of(_results(path))
        flown = sorted({on for name in DETECTORS if name in elsewhere
                        for on in elsewhere[name].platforms})  # fmt: skip
        if flown:
            raise RecordError(
                f"{path}: its flights with a detector flew on {' and '.join(flown)}, not on "
                f"{platform} (--platform): its kernels would be those of another computer; "
                f"mavfi fly --platform {platform} --detector {DETECTORS[-1]} records one"
            )
    if not known:
        others = f", only with {', '.join(of_each)}" if of_each else ""
        raise RecordError(
            f"{path}: no error-free flight with {' or '.join(DETECTORS)} is recorded there{others}"
            f"; mavfi fly --detector {DETECTORS[-1]} records one"
        )
    return {name: (100.0 * each.share, each.told(text)) for name, each in known.items()}


def _results(path: Path) -> Iterator[Mapping[str, Any]]:
    """result.json of a run folder, of all runs in a folder, or of all missions of a campaign."""
    from mavfi_cli.campaign.ledger import Ledger
    from mavfi_cli.mission.record.run_folder import load_run

    if path.is_file() or (path / _RESULT).is_file():
        yield load_run(path).result
        return
    for ledger in (each for pattern in _LEDGERS for each in sorted(path.glob(pattern))):
        with Ledger(ledger.parent) as opened:
            yield from (entry.result for entry in opened.results())
    for run in sorted(path.glob(f"*/{_RESULT}")):
        yield load_run(run).result
