"""The flown missions of a campaign, gathered by setting or by some of its factors.

Columns, not rows: a campaign may have a million missions.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.campaign.ledger import Ledger
from mavfi_cli.campaign.missions import canonical, label_text
from mavfi_cli.campaign.outcome import Injected
from mavfi_cli.campaign.stopping import COUNTED
from mavfi_cli.core.errors import UnknownName
from mavfi_cli.core.types import FloatArray

BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]

METRICS = ("flight_time_s", "distance_m", "energy_regression_j", "replans")
# Labels in which protected flights differ.
TREATMENT = ("setting", "detector", "protect", "any_stack", "watch")
INACTIVE = frozenset(each.value for each in Injected) - COUNTED


@dataclass(frozen=True, slots=True)
class Words:
    """A column of words, each written once.

    Attributes:
        known: the words, of all groups of a campaign.
        codes: (n,) which of them each row has.
    """

    known: Sequence[str]
    codes: IntArray

    def at(self, rows: IntArray) -> Words:
        """The words of some rows."""
        return Words(self.known, self.codes[rows])

    def among(self, words: Iterable[str]) -> BoolArray:
        """Whether each row has one of these, (n,)."""
        wanted = frozenset(words)
        return np.array([word in wanted for word in self.known], dtype=bool)[self.codes]

    def counts(self) -> dict[str, int]:
        """How often each word comes that comes at all."""
        often = np.bincount(self.codes, minlength=len(self.known)).tolist()
        return dict(sorted((w, n) for w, n in zip(self.known, often, strict=True) if n))


@dataclass(frozen=True)  # no slots: what is asked of all missions is computed once
class Group:
    """Missions that are counted together; columns of the flown ones, in the order of the list.

    Attributes:
        labels: what they have in common.
        lacked: labels by which missions are gathered and that these have not.
        planned, errors: on the list; of them such that could not begin.
        outcome, injected: (n,) how each ended, and the fate of its fault.
        watched: whether a detector watches all of them.
        number: (n,) of each mission.
        pair: (n,) what golden, faulty and protected flights share.
        strike: (n,) a code for what the labels say but for the treatment: of the fault.
        metrics: (n,) for each of METRICS; not a number where a mission has none.
    """

    labels: Mapping[str, Any]
    lacked: Sequence[str]
    planned: int
    errors: int
    watched: bool
    number: IntArray
    outcome: Words
    injected: Words
    pair: Words
    strike: IntArray
    metrics: Mapping[str, FloatArray]

    @property
    def name(self) -> str:
        """What they are in one phrase: their labels, and what they lack of what was asked for."""
        if not self.lacked or "setting" in self.labels:  # its name tells it apart
            return label_text(self.labels)
        less = "golden" if len(self.number) and self.golden else f"no {', '.join(self.lacked)}"
        return f"{label_text(self.labels)} {less}" if self.labels else less

    @cached_property
    def succeeded(self) -> BoolArray:
        """Whether each mission reached its goal, (n,)."""
        return self.outcome.among(("success",))

    @cached_property
    def counted(self) -> BoolArray:
        """Whether each mission is golden or its fault struck, (n,)."""
        return self.injected.among(COUNTED)

    def successes(self, metric: str) -> FloatArray:
        """A metric of the successful ones among those that count, where they have it."""
        found = self.metrics[metric][self.succeeded & self.counted]
        return found[~np.isnan(found)]

    @cached_property
    def golden(self) -> bool:
        """Whether no fault was asked for."""
        return bool(self.injected.among((Injected.GOLDEN.value,)).all())

    @cached_property
    def flown_pairs(self) -> BoolArray:
        """For each pair of the campaign, whether a mission of it counts here."""
        found = np.zeros(len(self.pair.known), dtype=bool)
        found[self.pair.codes[self.counted]] = True
        return found


def matched(first: Group, second: Group) -> tuple[IntArray, IntArray]:
    """Missions of equal pairs that count: places in the first, places in the second, (m,) each.

    In the order of the second. Missions with faults are of equal pairs where the same faults strike
    them. Of a pair that either flew more than once, the first time of one goes with the first of
    the other, and so on; one golden flight serves all.
    """
    places, others = np.flatnonzero(second.counted), np.flatnonzero(first.counted)
    pairs, known = second.pair.codes[places], first.pair.codes[others]
    if not first.golden:
        strikes, others_strikes = second.strike[places], first.strike[others]
        width = 1 + max(strikes.max(initial=0), others_strikes.max(initial=0))
        pairs, known = pairs * width + strikes, known * width + others_strikes
    times, others_times = _times(pairs), _times(known)
    if first.golden:
        times = np.zeros_like(times)
    most = 1 + max(times.max(initial=0), others_times.max(initial=0))
    keys, sought = known * most + others_times, pairs * most + times
    order = np.argsort(keys)
    keys, others = keys[order], others[order]
    at = np.searchsorted(keys, sought)
    found = np.isin(sought, keys)
    return others[at[found]], places[found]


def _times(codes: IntArray) -> IntArray:
    """How often each code came before, (n,)."""
    order = np.argsort(codes, kind="stable")
    ordered = codes[order]
    begins = np.flatnonzero(np.diff(ordered, prepend=-1))
    lengths = np.diff(begins, append=len(codes))
    times = np.empty_like(codes)
    times[order] = np.arange(len(codes)) - np.repeat(begins, lengths)
    return times


def untreated(labels: Mapping[str, Any]) -> str:
    """What protected and unprotected flights with the same faults have in common, as one text."""
    return canonical({name: value for name, value in labels.items() if name not in TREATMENT})


def groups(ledger: Ledger, by: Sequence[str] = ()) -> list[Group]:
    """The settings, or those together that have equal values of the labels `by`.

    Raises:
        UnknownName: no setting has such a label.
    """
    labels = ledger.cells()
    known = {name for each in labels for name in each}
    for name in by:
        if name not in known:
            raise UnknownName("label", name, known)
    kept = [{name: each[name] for name in by or each if name in each} for each in labels]
    members: dict[str, list[int]] = {}
    for cell, each in enumerate(kept):
        members.setdefault(canonical(each), []).append(cell)
    planned, errors = ledger.planned_by_cell(), ledger.errors_by_cell()
    cells, number, words, metrics = _columns(ledger)
    codes: dict[str, int] = {}
    strikes = np.array(
        [codes.setdefault(untreated(each), len(codes)) for each in labels], dtype=np.int64
    )
    group_of = np.zeros(len(labels), dtype=np.int64)
    for index, those in enumerate(members.values()):
        group_of[those] = index
    mine = group_of[cells]
    order = np.argsort(mine, kind="stable")
    ends = np.searchsorted(mine[order], np.arange(len(members)), side="right")
    return [
        Group(
            labels=kept[those[0]],
            lacked=[name for name in by if name not in kept[those[0]]],
            planned=sum(planned[cell] for cell in those),
            errors=sum(errors.get(cell, 0) for cell in those),
            watched=all(labels[cell].get("detector") not in (None, "none") for cell in those),
            number=number[rows],
            outcome=words["outcome"].at(rows),
            injected=words["injected"].at(rows),
            pair=words["pair"].at(rows),
            strike=strikes[cells[rows]],
            metrics={name: column[rows] for name, column in metrics.items()},
        )
        for those, rows in zip(members.values(), np.split(order, ends[:-1]), strict=True)
    ]


def _columns(
    ledger: Ledger,
) -> tuple[IntArray, IntArray, dict[str, Words], dict[str, FloatArray]]:
    """Of every flown mission its cell and number; outcome, fate and pair; METRICS."""
    codes: dict[str, dict[str, int]] = {"outcome": {}, "injected": {}, "pair": {}}
    parts: dict[str, list[NDArray[Any]]] = {
        "cell": [],
        "number": [],
        **{name: [] for name in codes},
    }
    parts |= {name: [] for name in METRICS}
    for portion in ledger.columns(list(parts)):
        for name, column in zip(parts, portion, strict=True):
            if name in METRICS:
                parts[name].append(np.array(column, dtype=np.float64))
            elif (seen := codes.get(name)) is None:
                parts[name].append(np.array(column, dtype=np.int64))
            else:
                coded = [seen.setdefault(str(word), len(seen)) for word in column]
                parts[name].append(np.array(coded, dtype=np.int64))
    whole = {
        name: np.concatenate([np.zeros(0, float if name in METRICS else np.int64), *found])
        for name, found in parts.items()
    }
    words = {name: Words(list(seen), whole[name]) for name, seen in codes.items()}
    return whole["cell"], whole["number"], words, {name: whole[name] for name in METRICS}
