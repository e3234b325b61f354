"""The ledger of a campaign: SQLite in WAL mode, one writer, one transaction per mission.

    meta      schema, versions, name and specification of the campaign
    cells     the settings: their numbers and labels
    missions  the numbered list, written before the first mission flies
    results   one short row per finished mission
    records   the complete result.json of each finished mission, compressed
    draws     the faults drawn for a stratified campaign's missions, with strata and weights

A mission is missing until it has a row in `results`. A kill at any moment leaves a complete row or
none.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import math
import os
import sqlite3
import zlib
from collections.abc import Collection, Generator, Iterable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from mavfi_cli.campaigns.missions import (
    Injected,
    Labels,
    MissingMission,
    MissionResult,
    PlannedMission,
    ResultState,
    Sampling,
    canonical,
)
from mavfi_cli.core.config import structure
from mavfi_cli.core.errors import ConfigError, RecordError
from mavfi_cli.core.files import (
    Json,
    inflate,
    open_own,
    plain,
    read_parquet,
    reading,
    writing,
)
from mavfi_cli.mission.measures import FlightRecord, fields_of
from mavfi_cli.spec.mission import MissionConfig

if TYPE_CHECKING:
    import pyarrow as pa

SCHEMA = 1
LEDGER, LOCK, RUNS = "ledger.sqlite", "ledger.lock", "runs"
_TABLES = """
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE cells (cell INTEGER PRIMARY KEY, labels TEXT NOT NULL UNIQUE);
CREATE TABLE missions (
    number INTEGER PRIMARY KEY,
    cell INTEGER NOT NULL REFERENCES cells,
    pair TEXT NOT NULL,
    changes TEXT NOT NULL
);
CREATE TABLE results (
    number INTEGER PRIMARY KEY REFERENCES missions,
    state TEXT NOT NULL,
    outcome TEXT,
    reason TEXT NOT NULL,
    injected TEXT,
    flight_time_s REAL,
    distance_m REAL,
    energy_regression_j REAL,
    energy_propeller_j REAL,
    min_clearance_m REAL,
    replans INTEGER,
    simulated_s REAL,
    wall_s REAL NOT NULL,
    attempts INTEGER NOT NULL,
    path TEXT
);
CREATE TABLE records (number INTEGER PRIMARY KEY REFERENCES results, result BLOB NOT NULL);
"""
_DRAWS = """
CREATE TABLE IF NOT EXISTS draws (
    number INTEGER PRIMARY KEY REFERENCES missions,
    round INTEGER NOT NULL,
    stratum TEXT NOT NULL,
    weight REAL NOT NULL,
    pair TEXT NOT NULL,
    changes TEXT NOT NULL
)
"""
# The missions as flown: from a uniform list, and from a list whose faults are drawn in rounds.
_PLANNED = "(SELECT *, NULL AS stratum, 1.0 AS weight FROM missions)"
_DRAWN = (
    "(SELECT m.number, cell, COALESCE(d.pair, m.pair) AS pair, COALESCE(d.changes, m.changes) AS "
    "changes, stratum, COALESCE(weight, 1.0) AS weight FROM missions AS m LEFT JOIN draws AS d "
    "USING (number))"
)
# SQL for `columns`: whether a mission's flight repeats exactly. A flight of a user's companion does
# not, because it depends on the wall clock.
REPEATS = "instr(changes, '\"companion\":') = 0"
_SHORT = (
    "flight_time_s", "distance_m", "energy_regression_j", "energy_propeller_j", "min_clearance_m",
    "replans", "simulated_s",
)  # fmt: skip
_LARGEST_RECORD = 1 << 27  # bytes of JSON
_PORTION = 5000  # rows that are read at once


def _object(text: str | bytes) -> dict[str, Any]:
    """Parse a JSON object. Raise TypeError or ValueError if the text is anything else."""
    value = json.loads(text)
    if not isinstance(value, dict):
        raise TypeError(f"must be a JSON object, got a {type(value).__name__}")
    return value


class Drawn(NamedTuple):
    """The fault drawn for a mission of a stratified campaign.

    Attributes:
        round: zero-based number of the round in which it was drawn.
        weight: number of uniformly drawn missions that this mission represents.
        pair, changes: the mission's pair and configuration with this fault, in the format in which
            the list of missions stores them.
    """

    number: int
    round: int
    stratum: str
    weight: float
    pair: str
    changes: str


class Ledger:
    """The database of one campaign: its list of missions, and their results.

    Use it as a context manager. Any number of readers may run alongside one writer.

    Attributes:
        export: the table of flights if the ledger was opened from an export, otherwise None.
    """

    export: pa.Table | None = None

    def __init__(self, folder: Path, *, writing: bool = False, memory: bool = False) -> None:
        """Open the ledger in a folder. If `writing` is set, create a missing folder and ledger.

        With `memory`, open an empty ledger in memory instead; `folder` then only appears in error
        messages.

        Raises:
            RecordError: the ledger is missing, damaged, or cannot be opened.
            ConfigError: its schema version is not supported, or another process is writing to it.
        """
        self.folder = folder
        self._path = folder if memory else folder / LEDGER
        self._list = _PLANNED
        self._lock: int | None = None  # descriptor
        self._writing = writing
        with contextlib.ExitStack() as undo:
            if writing:
                self._become_writer()
                undo.callback(self._unlock)
            elif not (memory or self._path.is_file()):
                raise RecordError(f"{folder}: holds no campaign ({LEDGER} is missing)")
            if not memory and self._path.is_symlink():
                raise RecordError(f"{self._path}: must not be a symbolic link")
            try:
                self._db = self._connect(memory)
                undo.callback(self._db.close)
                self._check(new=writing or memory)
            except sqlite3.Error as error:
                raise RecordError(f"{self._path}: {error}") from None
            undo.pop_all()

    def __enter__(self) -> Ledger:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the ledger, and release its lock if it was open for writing."""
        self._db.close()
        self._unlock()

    def _become_writer(self) -> None:
        with writing(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
        with writing(self.folder / LOCK):
            self._lock = open_own(self.folder / LOCK, os.O_RDWR)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self._unlock()
            raise ConfigError("is being run by another process", path=self.folder) from None

    def _unlock(self) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def _connect(self, memory: bool) -> sqlite3.Connection:
        if memory:
            return sqlite3.connect(":memory:", isolation_level=None)
        mode = "rwc" if self._writing else "rw"  # a reader of a WAL file writes its index
        places = (self._path, self._path.parent)
        if not self._writing and not all(os.access(place, os.W_OK) for place in places):
            log = self._path.with_name(f"{LEDGER}-wal")
            if log.is_file() and log.stat().st_size:
                raise ConfigError(
                    "is read-only, and its run has not ended; read a copy of it", path=self.folder
                )
            mode = "ro&immutable=1"
        uri = f"{self._path.absolute().as_uri()}?mode={mode}"
        connection = sqlite3.connect(uri, uri=True, isolation_level=None, timeout=30.0)
        if self._writing:
            connection.execute("PRAGMA journal_mode = WAL")
            connection.execute("PRAGMA synchronous = FULL")  # a power cut loses no finished mission
        else:
            connection.execute("PRAGMA query_only = ON")
        return connection

    def _check(self, *, new: bool) -> None:
        tables = {row[0] for row in self._db.execute("SELECT name FROM sqlite_master")}
        if not tables and new:
            with self._transaction():
                for statement in _TABLES.split(";"):
                    self._db.execute(statement)
                self._db.execute("INSERT INTO meta VALUES ('schema', ?)", (str(SCHEMA),))
            return
        schema = self.meta("schema") if "meta" in tables else None
        if schema != str(SCHEMA):
            version = f"of version {schema}" if schema is not None else "of no version"
            raise ConfigError(
                f"is a ledger {version}; this mavfi supports only version {SCHEMA}", path=self._path
            )
        self._list = _DRAWN if "draws" in tables else _PLANNED

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[None]:
        try:
            self._db.execute("BEGIN IMMEDIATE")
            yield
            self._db.execute("COMMIT")
        except sqlite3.Error as error:
            raise RecordError(f"{self._path}: {error}") from None
        finally:
            if self._db.in_transaction:  # it was not committed
                with contextlib.suppress(sqlite3.Error):
                    self._db.execute("ROLLBACK")

    def _rows(self, query: str, *values: object) -> Generator[Any]:
        """Yield the rows of a query.

        Raises:
            RecordError: the ledger is damaged.
        """
        try:
            for row in self._db.execute(query, values):  # noqa: UP028 (yield from closes too late)
                yield row
        except sqlite3.Error as error:
            raise RecordError(f"{self._path}: {error}") from None

    # The campaign ---------------------------------------------------------------------------------

    def meta(self, key: str) -> str | None:
        """Return the text stored under `key` in the campaign's metadata, or None if it is unset."""
        values = [
            str(value) for (value,) in self._rows("SELECT value FROM meta WHERE key = ?", key)
        ]
        return values[0] if values else None

    def set_meta(self, values: Mapping[str, str]) -> None:
        """Store metadata of the campaign under the given keys, replacing earlier values."""
        with self._transaction():
            self._db.executemany("REPLACE INTO meta VALUES (?, ?)", values.items())

    def plan(self, missions: Iterable[PlannedMission]) -> int:
        """Append missions to the list, and return how many were appended.

        Raises:
            RecordError: the ledger cannot be written, for example because the disk is full.
        """
        first = self.planned()
        known = {labels: cell for cell, labels in self._rows("SELECT * FROM cells")}
        count = 0
        with self._transaction():
            for count, mission in enumerate(missions, start=1):
                labels, pair, changes = mission.stored
                if labels not in known:
                    known[labels] = len(known)
                    self._db.execute("INSERT INTO cells VALUES (?, ?)", (known[labels], labels))
                row = (first + count - 1, known[labels], pair, changes)
                self._db.execute("INSERT INTO missions VALUES (?, ?, ?, ?)", row)
        return count

    @property
    def stratified(self) -> bool:
        """Whether faults are drawn by stratum, so that missions have unequal weights."""
        return self._list == _DRAWN

    @property
    def sampling(self) -> Sampling:
        """How the faults of the campaign are drawn."""
        return Sampling.STRATIFIED if self.stratified else Sampling.UNIFORM

    def draw(self, rows: Iterable[Drawn]) -> None:
        """Store the faults drawn for missions in one transaction, replacing those on the list."""
        self._list = _DRAWN
        with self._transaction():
            self._db.execute(_DRAWS)
            self._db.executemany("INSERT INTO draws VALUES (?, ?, ?, ?, ?, ?)", rows)

    def draws(self) -> dict[int, Drawn]:
        """Return the drawn faults, keyed by mission number. A uniform campaign has none."""
        rows = self._rows("SELECT * FROM draws") if self.stratified else ()
        return {row[0]: Drawn(*row) for row in rows}

    def fill(
        self,
        name: str,
        cells: Mapping[str, int],
        missions: Iterable[tuple[int, int, str, str]],
        results: Iterable[Json],
        draws: Sequence[Drawn] = (),
    ) -> None:
        """Fill an empty ledger with a campaign's settings, missions and results, without records.

        Args:
            name: name of the campaign.
            cells: number of each setting, keyed by its labels as canonical JSON.
            missions: number, setting's number, pair and changes of every mission.
            results: for each finished mission, its values in the table `results`, keyed by column;
                a missing column is stored as NULL.
            draws: the faults drawn for missions of a stratified campaign.

        Raises:
            RecordError: a row has the wrong types, or a number occurs twice.
        """
        own = [column[1] for column in self._rows("PRAGMA table_info(results)")]
        marks = ", ".join("?" * len(own))
        given = ([result.get(column) for column in own] for result in results)
        with self._transaction():
            self._db.execute("INSERT INTO meta VALUES ('name', ?)", (name,))
            rows = ((number, labels) for labels, number in cells.items())
            self._db.executemany("INSERT INTO cells VALUES (?, ?)", rows)
            self._db.executemany("INSERT INTO missions VALUES (?, ?, ?, ?)", missions)
            self._db.executemany(f"INSERT INTO results VALUES ({marks})", given)
        if draws:
            self.draw(draws)

    def planned(self) -> int:
        """Return the number of missions on the list."""
        ((count,),) = self._rows("SELECT count(*) FROM missions")
        return int(count)

    def cells(self) -> list[Labels]:
        """Return the labels of each setting, in order of the settings' numbers.

        Raises:
            RecordError: the ledger is damaged, for example because a mission's setting is missing.
        """
        with reading(self._path):
            cells: list[Labels] = [
                _object(text) for (text,) in self._rows("SELECT labels FROM cells ORDER BY cell")
            ]
            for (cell,) in self._rows("SELECT DISTINCT cell FROM missions"):
                if cell not in range(len(cells)):
                    raise ValueError(f"a mission refers to the missing setting {cell!r}")
        return cells

    def rows(self) -> Iterator[tuple[int, str, str, str]]:
        """Yield the number, labels, pair and changes of every mission, as the list stores them.

        The faults drawn for a stratified campaign are not applied; see `draws`.
        """
        yield from self._rows(
            "SELECT number, labels, pair, changes FROM missions JOIN cells USING (cell) "
            "ORDER BY number"
        )

    # Missions to fly ------------------------------------------------------------------------------

    def missing(
        self, *, errors: bool = False, among: Collection[int] | None = None
    ) -> Iterator[MissingMission]:
        """Yield the missions without a result, in the order of the list.

        Missions are read 1,000 at a time, so the caller may add results while iterating.

        Args:
            errors: include missions that could not begin.
            among: numbers of the missions to choose from; None means all.
        """
        chosen = "" if among is None else " AND number IN (SELECT value FROM json_each(?))"
        numbers = [] if among is None else [json.dumps(sorted(among))]
        over = "SELECT 1 FROM results WHERE results.number = planned.number"
        over += " AND state <> 'error'" if errors else ""
        last = -1
        while True:
            rows = list(
                self._rows(
                    f"SELECT number, cell, changes FROM {self._list} AS planned WHERE number > ? "
                    f"AND NOT EXISTS ({over}){chosen} ORDER BY number LIMIT 1000",
                    last,
                    *numbers,
                )
            )
            for number, cell, text in rows:
                with reading(self._path):
                    config = structure(_object(text), MissionConfig)
                yield MissingMission(number, cell, config)
                last = number
            if not rows:
                return

    def mission_cells(self) -> list[int]:
        """Return the number of each mission's setting, in the order of the list."""
        return [cell for (cell,) in self._rows("SELECT cell FROM missions ORDER BY number")]

    def fates(self, *, errors: bool = True) -> Iterator[tuple[int, tuple[str | None, str | None]]]:
        """Yield the number of every finished mission, and its outcome with the fate of its fault.

        Both the outcome and the fate are None for a mission that could not begin.

        Args:
            errors: include missions that could not begin.
        """
        over = "" if errors else " WHERE state <> 'error'"
        for number, *fate in self._rows(f"SELECT number, outcome, injected FROM results{over}"):
            yield number, (fate[0], fate[1])

    def over(self) -> int:
        """Return the number of finished missions, including those that could not begin."""
        ((count,),) = self._rows("SELECT count(*) FROM results")
        return int(count)

    def add(
        self,
        number: int,
        *,
        state: ResultState,
        result: Json,
        reason: str,
        injected: Injected | None,
        wall_s: float,
        attempts: int,
        path: str | None,
    ) -> None:
        """Store the result of a mission in one transaction, replacing any earlier result.

        Raises:
            RecordError: the ledger cannot be written, for example because the disk is full.
        """
        flight = FlightRecord.of(result)
        columns = fields_of(flight)
        row = (
            number,
            state.value,
            flight.outcome or None,
            reason,
            None if injected is None else injected.value,
            *(columns[name] for name in _SHORT),
            wall_s,
            attempts,
            path,
        )
        blob = zlib.compress(canonical(plain(dict(result))).encode())
        marks = ", ".join("?" * len(row))
        with self._transaction():
            self._db.execute(f"REPLACE INTO results VALUES ({marks})", row)
            self._db.execute("REPLACE INTO records VALUES (?, ?)", (number, blob))

    # Results --------------------------------------------------------------------------------------

    def results(self, numbers: Sequence[int] | None = None) -> Iterator[MissionResult]:
        """Yield the results of finished missions in the order of the list.

        Args:
            numbers: numbers of the missions; None means all.
        """
        chosen = "" if numbers is None else "WHERE number IN (SELECT value FROM json_each(?)) "
        rows = self._rows(
            "SELECT number, labels, pair, changes, state, outcome, reason, injected, wall_s, "
            "attempts, path, result, stratum, weight "
            f"FROM results JOIN {self._list} USING (number) JOIN cells USING (cell) "
            f"JOIN records USING (number) {chosen}ORDER BY number",
            *([] if numbers is None else [json.dumps(list(numbers))]),
        )
        with contextlib.closing(rows):  # closes before the ledger, even after an error
            for number, labels, pair, changes, state, outcome, reason, injected, *rest in rows:
                wall_s, attempts, path, blob, stratum, weight = rest
                with reading(self._path):
                    over = MissionResult(
                        number=number,
                        mission=PlannedMission(
                            config=structure(_object(changes), MissionConfig),
                            labels=_object(labels),
                            pair=pair,
                        ),
                        state=ResultState(state),
                        outcome=outcome,
                        reason=reason,
                        result=_object(inflate(blob, _LARGEST_RECORD)),
                        injected=None if injected is None else Injected(injected),
                        wall_s=wall_s,
                        attempts=attempts,
                        path=None if path is None else self.folder.absolute() / path,
                        stratum=stratum,
                        weight=weight,
                    )
                yield over

    def configs(self, numbers: Sequence[int]) -> Iterator[MissionConfig]:
        """Yield the configurations of the missions with these numbers, in the order of the list.

        Raises:
            RecordError: the stored changes of a mission are invalid.
        """
        rows = self._rows(
            f"SELECT number, changes FROM {self._list} "
            "WHERE number IN (SELECT value FROM json_each(?)) ORDER BY number",
            json.dumps(list(numbers)),
        )
        for number, changes in rows:
            try:
                config = structure(_object(changes), MissionConfig)
            except (TypeError, ValueError, ConfigError) as error:
                problem = f"cannot read the configuration of mission {number} ({error})"
                raise RecordError(f"{self.folder}: {problem}") from None
            yield config

    def columns(self, names: Sequence[str]) -> Iterator[list[tuple[Any, ...]]]:
        """Yield the named columns of all flown missions, in the order of the list.

        The columns come in portions of rows. A portion is a list of columns, in the order of
        `names`.

        Args:
            names: columns of the tables `missions` and `results`, `stratum`, `weight`, or the SQL
                expression REPEATS.
        """
        rows = self._rows(
            f"SELECT {', '.join(names)} FROM results JOIN {self._list} USING (number) "
            "WHERE state = 'flown' ORDER BY number"
        )
        while portion := list(islice(rows, _PORTION)):
            yield list(zip(*portion, strict=True))

    def errors_by_cell(self) -> dict[int, int]:
        """Count the missions that could not begin, keyed by setting number.

        Settings without such missions are omitted.
        """
        return dict(
            self._rows(
                "SELECT cell, count(*) FROM results JOIN missions USING (number) "
                "WHERE state = 'error' GROUP BY cell"
            )
        )

    def planned_by_cell(self) -> list[int]:
        """Return the number of planned missions in each setting, in order of setting numbers."""
        rows = self._rows("SELECT count(*) FROM missions GROUP BY cell ORDER BY cell")
        return [count for (count,) in rows]


# Exports ------------------------------------------------------------------------------------------

EXPORT = ".parquet"
METADATA = b"mavfi"  # key of an export's provenance
_NEEDED = ("number", "pair", "world", "seed", "stack", "state", "outcome", "injected", "changes")
_LABEL = "label_"
STRATUM, WEIGHT = "stratum", "weight"  # columns of a stratified sample; otherwise weights are 1
_ABSENT = {"reason": "", "wall_s": 0.0, "attempts": 1}  # values for columns that an export lacks


def is_export(path: Path) -> bool:
    """Return True if a path has the suffix of an exported campaign and is not a folder."""
    return path.suffix == EXPORT and not path.is_dir()


def stored_export(path: Path) -> pa.Table:
    """Read the table of an exported campaign, and check that it is complete.

    Raises:
        RecordError: the file is missing or damaged, lacks a column or a weight, or lists a mission
            twice.
    """
    import pyarrow.compute as pc

    if not path.is_file():
        raise RecordError(f"{path}: no such file")
    table = read_parquet(path, "export of a campaign")
    for name in _NEEDED:
        if name not in table.column_names:
            raise _no_export(path, f"it has no column {name!r}")
    counts = pc.value_counts(table["number"]).to_pylist()
    twice = next((entry["values"] for entry in counts if entry["counts"] > 1), None)
    if twice is not None:
        problem = f"it lists mission {twice} twice; keep the exports of two campaigns in two files"
        raise _no_export(path, problem)
    try:
        origin = stored_provenance(table)
    except (TypeError, ValueError):
        raise _no_export(path, "its metadata is damaged") from None
    _require_weights(table, path, stratified=origin.get("sampling") == Sampling.STRATIFIED.value)
    return table


def _require_weights(table: pa.Table, path: Path, *, stratified: bool) -> None:
    """Raise RecordError if a mission of a stratified sample lacks a valid weight.

    Merging exports of a stratified and a uniform campaign can lose weights.
    """
    names = [name for name in (STRATUM, WEIGHT) if name in table.column_names]
    rows = table.select(["number", *names]).to_pylist() if stratified or STRATUM in names else []
    for row in rows:
        weight = row.get(WEIGHT)
        if (stratified or row[STRATUM] is not None) and not (
            isinstance(weight, float) and 0.0 < weight < math.inf
        ):
            raise RecordError(
                f"{path}: mission {row['number']} of a stratified sample must have a weight above "
                f"0, got {weight}; export the campaign again"
            )


def _no_export(path: Path, why: object) -> RecordError:
    return RecordError(f"{path}: not an export of a campaign ({why})")


def stored_provenance(table: pa.Table) -> dict[str, Any]:
    """Return the provenance stored in an export's metadata, or an empty dict without any."""
    return dict(json.loads((table.schema.metadata or {}).get(METADATA, b"{}")))


class ExportedLedger(Ledger):
    """An in-memory ledger with the missions and results of an export, but no flight records.

    Raises:
        RecordError: the file is not an export.
    """

    def __init__(self, path: Path) -> None:
        self.export = table = stored_export(path)
        super().__init__(path, memory=True)
        origin = stored_provenance(table)
        labels = [name for name in table.column_names if name.startswith(_LABEL)]
        cells: dict[str, int] = {}
        missions = []
        rows = table.to_pylist()
        for row in rows:
            own = {name.removeprefix(_LABEL): row[name] for name in labels if row[name] is not None}
            try:
                cell = cells.setdefault(canonical(own), len(cells))
            except TypeError as error:  # a label of an unsupported type
                raise _no_export(path, error) from None
            missions.append((row["number"], cell, row["pair"], row["changes"]))
        name = str(origin.get("name") or path.stem)
        known = ({key: value for key, value in row.items() if value is not None} for row in rows)
        draws = [
            Drawn(row["number"], 0, row[STRATUM], row[WEIGHT], row["pair"], row["changes"])
            for row in rows
            if row.get(STRATUM) is not None
        ]
        self.fill(name, cells, missions, (_ABSENT | row for row in known), draws)

    def results(self, numbers: Sequence[int] | None = None) -> Iterator[MissionResult]:
        """Raise RecordError, because an export contains no flight records.

        Raises:
            RecordError: always.
        """
        raise RecordError(
            f"{self.folder}: cannot read flight records, because an export does not contain them; "
            "use the campaign's folder"
        )
