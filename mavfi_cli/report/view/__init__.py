"""Shows flights in rerun's viewer, or writes them to a file for rerun or Foxglove."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from mavfi_cli.core.errors import ConfigError, MavfiError
from mavfi_cli.core.files import require_output
from mavfi_cli.report.view.entries import ViewedFlight

# Suffix of a file, or None for rerun's window -> what it needs, and the extra that installs it.
_NEEDED = {None: ("rerun", "view"), ".rrd": ("rerun", "view"), ".mcap": ("mcap_protobuf", "mcap")}


def require_viewer(path: Path | None) -> None:
    """Check that flights can be written to `path`, or shown in rerun's window if it is None.

    Raises:
        ConfigError: the suffix is neither .rrd nor .mcap.
        MavfiError: a package is not installed, or there is no display.
        RecordError: the folder does not exist.
    """
    suffix = None if path is None else path.suffix.lower()
    if suffix not in _NEEDED:
        raise ConfigError("must end in .rrd (for rerun) or .mcap (for Foxglove)", path=path)
    package, extra = _NEEDED[suffix]
    if find_spec(package) is None:
        what = "rerun's window" if path is None else f"a {suffix} file"
        raise MavfiError(f"{what} needs optional packages: pip install 'mavfi[{extra}]'")
    if path is not None:
        require_output(path)
    elif sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys():
        raise MavfiError("cannot open rerun's window: no display; use --save FILE.rrd")


def save(flights: Sequence[ViewedFlight], path: Path | None) -> None:
    """Write flights to a file for a viewer, in the format that the suffix of `path` selects.

    The file is written atomically. If `path` is None, open rerun's viewer and leave it open.

    Raises:
        ConfigError: the suffix is neither .rrd nor .mcap.
        RecordError: the file cannot be written.
        MavfiError: a package is not installed.
    """
    require_viewer(path)
    if path is not None and path.suffix.lower() == ".mcap":
        from mavfi_cli.report.view.mcap_file import write_mcap

        write_mcap(flights, path)
    else:
        from mavfi_cli.report.view.rerun_file import write_rrd

        write_rrd(flights, path)
