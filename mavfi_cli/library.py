"""The functions behind `import mavfi_cli as mavfi` and behind the commands of the same names."""

from __future__ import annotations

from dataclasses import asdict, dataclass, is_dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavfi_cli.core.errors import MavfiError
from mavfi_cli.core.files import require_folder
from mavfi_cli.mission.run_folder import Run, load_run
from mavfi_cli.report.summary import run_html

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

    from mavfi_cli.fi.tracer.record_fields import FaultRecord
    from mavfi_cli.mission.progress import Recorder, Watcher
    from mavfi_cli.spec.mission import MissionConfig

Run.to_html = run_html


def fly(
    config: MissionConfig | None = None,
    *,
    out: str | Path = "runs",
    watcher: Watcher | None = None,
    recorder: Recorder | None = None,
    repeat: FaultRecord | None = None,
    **settings: Any,
) -> Run:
    """Fly one mission, save its run folder in `out`, and return the run that was loaded from it.

    A mission that ends in a collision, crash or other failure is a result, not an error.

    Args:
        config: Mission; None selects the defaults of `MissionConfig`.
        out: Folder in which the run folder is created.
        watcher: Receives progress and events.
        recorder: Records what the nodes receive: depth frames, clouds, maps and plan requests.
        repeat: Record of an instruction-level fault to repeat instead of drawing a new one.
        settings: Fields of `MissionConfig` that replace those of `config`. `fault`, `instruction`
            and `detector` take their dataclasses, or mappings with the same keys.

    Raises:
        ConfigError: `MissionConfig` has no such setting. The message suggests the nearest name.
        ConfigError: A setting has the wrong type or is out of range.
        MavfiError: The mission could not begin, or its record could not be written.
    """
    mission = _mission(config, settings)
    require_folder(Path(out))
    if (
        mission.instruction is not None and mission.companion is None
    ):  # start the attacked node's process now, so that it loads in parallel
        from mavfi_cli.attack.served import ServedProcess
        from mavfi_cli.mission.instruction import PROGRAM

        ServedProcess.start_early(PROGRAM)
    from mavfi_cli.mission.progress import Watcher
    from mavfi_cli.mission.run import fly_mission

    folder = fly_mission(mission, Path(out), watcher or Watcher(), recorder=recorder, repeat=repeat)
    return load_run(folder.path)


def _mission(config: MissionConfig | None, settings: dict[str, Any]) -> MissionConfig:
    from mavfi_cli.core.config import structure
    from mavfi_cli.spec.mission import MissionConfig

    base = config or MissionConfig()
    if not settings:
        return base
    given = {name: _plain(value) for name, value in settings.items()}
    return structure({**asdict(base), **given}, MissionConfig)


def _plain(value: Any) -> Any:
    return asdict(value) if is_dataclass(value) and not isinstance(value, type) else value


@dataclass(frozen=True, slots=True, kw_only=True)
class Campaign:
    """The results of a campaign, read from its folder or from an exported file.

    Attributes:
        folder: Path of the campaign's folder, or of the exported file.
        table: One row per finished mission, in the order of the campaign's list, with the columns
            that `mavfi campaign export` writes.
    """

    folder: Path
    table: pa.Table

    def __repr__(self) -> str:
        return f"Campaign({str(self.folder)!r}, missions={self.table.num_rows})"

    def _repr_html_(self) -> str | None:
        """Return the table as HTML for display in a notebook, or None if pandas is missing."""
        if find_spec("pandas") is None:
            return None
        html: str = self.to_pandas()._repr_html_()
        return html

    def to_pandas(self) -> pd.DataFrame:
        """Return the table as a pandas data frame.

        Raises:
            MavfiError: pandas is not installed.
        """
        try:
            import pandas  # noqa: F401  pyarrow's own error does not name the extra
        except ImportError:
            raise MavfiError(
                "to_pandas needs pandas, which is not installed; "
                "install it with: pip install 'mavfi[pandas]'"
            ) from None
        return self.table.to_pandas()


def campaign(what: str | Path) -> Campaign:
    """Read the results of a campaign. The campaign may still be running.

    Args:
        what: Folder or exported .parquet file of a campaign, or a preset or TOML file whose
            campaign folder is campaigns/NAME.

    Raises:
        UnknownName: There is no such folder or preset.
        MavfiError: The folder holds no campaign, or its records cannot be read.
    """
    from mavfi_cli.analysis.flights import exported
    from mavfi_cli.campaigns.begin import opened

    with opened(what) as ledger:
        return Campaign(folder=ledger.folder, table=exported(ledger))
