"""The flown missions of a campaign, grouped by setting or by labels.

Reads the short rows of the ledger, because a campaign may have a million missions.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from mavfi_cli.analysis.flights import BoolArray, IntArray, known, numbers, paired
from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.campaigns.missions import COUNTED, Injected, canonical, label_text
from mavfi_cli.core.errors import UnknownName
from mavfi_cli.core.types import FloatArray, Outcome

RESAMPLES = 1999
METRICS = ("flight_time_s", "distance_m", "energy_regression_j", "replans")
# Labels in which protected flights differ from unprotected ones.
TREATMENT = ("setting", "detector", "protect", "any_stack", "watch")
INACTIVE = frozenset(each.value for each in Injected) - COUNTED
_WHOLE = ("cell", "number")
_WORDS = ("outcome", "injected", "pair")


@dataclass(frozen=True)  # no slots: cached properties need a dict
class Group:
    """Missions that are counted together.

    Attributes:
        labels: common labels.
        lacked: grouping labels that these missions lack.
        planned, errors: missions on the list; those of them that could not begin.
        watched: whether a detector watches all of them.
        flights: the flown ones, in the order of the list: `number`, `outcome`, `injected`, METRICS;
            `pair` and `strike` are codes: of what golden, faulty and protected flights share, and
            of what the labels say but for the treatment, which is the fault.
    """

    labels: Mapping[str, Any]
    lacked: Sequence[str]
    planned: int
    errors: int
    watched: bool
    flights: pa.Table

    @property
    def name(self) -> str:
        """A phrase of their labels and of the grouping labels that they lack."""
        if not self.lacked or "setting" in self.labels:  # its name identifies it
            return label_text(self.labels)
        less = "golden" if self.flights.num_rows and self.golden else f"no {', '.join(self.lacked)}"
        return f"{label_text(self.labels)} {less}" if self.labels else less

    @cached_property
    def metrics(self) -> Mapping[str, FloatArray]:
        """METRICS, (n,) each; NaN if a mission has none."""
        return {name: numbers(self.flights, name) for name in METRICS}

    @cached_property
    def succeeded(self) -> BoolArray:
        """Whether each mission reached its goal, (n,)."""
        return self.among("outcome", (Outcome.SUCCESS.value,))

    @cached_property
    def counted(self) -> BoolArray:
        """Whether each mission is golden or its fault struck, (n,)."""
        return self.among("injected", COUNTED)

    @cached_property
    def golden(self) -> bool:
        """Whether the missions have no fault."""
        return bool(self.among("injected", (Injected.GOLDEN.value,)).all())

    @cached_property
    def pairs(self) -> IntArray:
        """The distinct pairs of the counted missions."""
        return np.unique(self.codes("pair")[self.counted])

    def codes(self, name: str) -> IntArray:
        """An integer column, (n,)."""
        return np.asarray(self.flights[name].to_numpy(), dtype=np.int64)

    def among(self, name: str, words: Iterable[str]) -> BoolArray:
        """Whether each mission has one of these words in a text column, (n,)."""
        found = pc.is_in(self.flights[name], value_set=pa.array(sorted(words), pa.string()))
        return np.asarray(found.to_numpy(), dtype=bool)

    def counts(self, name: str) -> dict[str, int]:
        """Number of occurrences of each word in a column."""
        found = pc.value_counts(self.flights[name]).to_pylist()
        return dict(sorted((each["values"], each["counts"]) for each in found))

    def successes(self, metric: str) -> FloatArray:
        """A metric of the counted successful missions that have it."""
        return known(self.metrics[metric][self.succeeded & self.counted])


def matched(first: Group, second: Group) -> tuple[IntArray, IntArray]:
    """Counted missions of equal pairs: row indices in the first and in the second, (m,) each.

    The order is that of the second. Missions with faults match if the same faults strike them.
    If a pair was flown several times, the first flights match, then the second ones, and so on.
    One golden flight matches all.
    """
    alike = ("pair",) if first.golden else ("pair", "strike")
    here, there = _timed(first, alike), _timed(second, alike)
    if first.golden:
        here = here.filter(pc.equal(here["time"], 0))
        here, there = paired(here, there, alike)
    else:
        here, there = paired(here, there, (*alike, "time"))
    return here["place"].to_numpy(), there["place"].to_numpy()


def _timed(group: Group, alike: Sequence[str]) -> pa.Table:
    """Row index and `alike` of each counted mission, and the number of earlier equal ones."""
    places = np.flatnonzero(group.counted)
    columns = {name: group.codes(name)[places] for name in alike}
    order = np.lexsort([*columns.values()])  # stable
    new = np.ones(len(places), dtype=bool)
    if len(places):
        new[1:] = np.any([np.diff(column[order]) != 0 for column in columns.values()], axis=0)
    begins = np.flatnonzero(new)
    times = np.empty(len(places), dtype=np.int64)
    times[order] = np.arange(len(places)) - np.repeat(begins, np.diff(begins, append=len(places)))
    return pa.table({**columns, "time": times, "place": places})


def untreated(labels: Mapping[str, Any]) -> str:
    """The labels that protected and unprotected flights with the same faults share, as text."""
    return canonical({name: value for name, value in labels.items() if name not in TREATMENT})


def groups(ledger: Ledger, by: Sequence[str] = ()) -> list[Group]:
    """The settings, merged if they have equal values of the labels `by`.

    Raises:
        UnknownName: no setting has such a label.
    """
    labels = ledger.cells()
    names = {name for each in labels for name in each}
    for name in by:
        if name not in names:
            raise UnknownName("label", name, names)
    kept = [{name: each[name] for name in by or each if name in each} for each in labels]
    members: dict[str, list[int]] = {}
    for cell, each in enumerate(kept):
        members.setdefault(canonical(each), []).append(cell)
    planned, errors = ledger.planned_by_cell(), ledger.errors_by_cell()
    parts = _parts(_short_rows(ledger, labels), list(members.values()), len(labels))
    return [
        Group(
            labels=kept[those[0]],
            lacked=[name for name in by if name not in kept[those[0]]],
            planned=sum(planned[cell] for cell in those),
            errors=sum(errors.get(cell, 0) for cell in those),
            watched=all(labels[cell].get("detector") not in (None, "none") for cell in those),
            flights=part,
        )
        for those, part in zip(members.values(), parts, strict=True)
    ]


def _short_rows(ledger: Ledger, labels: Sequence[Mapping[str, Any]]) -> pa.Table:
    """All flown missions; see `Group.flights`."""
    kinds = dict.fromkeys(_WHOLE, pa.int64()) | dict.fromkeys(_WORDS, pa.string())
    schema = pa.schema(kinds | dict.fromkeys(METRICS, pa.float64()))
    portions = [
        pa.table([pa.array(c, t) for c, t in zip(portion, schema.types, strict=True)], schema)
        for portion in ledger.columns(schema.names)
    ]
    whole = pa.concat_tables(portions or [schema.empty_table()]).combine_chunks()
    strikes: dict[str, int] = {}
    coded = [strikes.setdefault(untreated(each), len(strikes)) for each in labels]
    pairs = pc.dictionary_encode(whole["pair"]).combine_chunks()
    indices = pairs.indices if isinstance(pairs, pa.DictionaryArray) else pairs.chunk(0).indices
    return whole.set_column(whole.schema.get_field_index("pair"), "pair", indices).append_column(
        "strike", pa.array(np.array(coded, dtype=np.int64)[whole["cell"].to_numpy()])
    )


def _parts(whole: pa.Table, members: Sequence[Sequence[int]], cells: int) -> list[pa.Table]:
    """The rows of each group of cells, in the order of the list."""
    group_of = np.zeros(cells, dtype=np.int64)
    for index, those in enumerate(members):
        group_of[those] = index
    mine = group_of[whole["cell"].to_numpy()]
    ordered = whole.take(np.argsort(mine, kind="stable"))
    ends = np.searchsorted(np.sort(mine), np.arange(len(members)), side="right").tolist()
    begins = [0, *ends][:-1]
    return [ordered.slice(a, b - a) for a, b in zip(begins, ends, strict=True)]
