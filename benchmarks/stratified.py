"""Compares stratified with uniform sampling on recorded missions, whose rates are known.

    python benchmarks/stratified.py [--missions 200] [--repetitions 200] [EXPORT ...]

The population consists of the exported missions without a detector in which an instruction-level
fault struck. A stratum is the kernel that was struck; for planners, it is the first or a later
planning request instead. Samples of the population are drawn with replacement, uniformly and in the
rounds of a stratified campaign. The rate is that of lost missions.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from mavfi_cli.analysis.flights import read_export
from mavfi_cli.campaigns.strata import ROUND
from mavfi_cli.stats.shares import Share, wilson
from mavfi_cli.stats.strata import allocate, spread, weighted_share

RESULTS = Path(__file__).parents[1] / "docs" / "results"
DEFAULT = (RESULTS / "paper-mavbench.parquet", RESULTS / "instruction.parquet")
PLANNERS = ("rrtstar", "rrt", "rrtconnect", "planner")
Cells = Mapping[str, np.ndarray]  # whether each mission of a stratum is lost


def cells(paths: Sequence[Path]) -> dict[str, Cells]:
    """Return two populations: the strata of faults in planners, and of faults in all nodes."""
    losses: dict[str, list[bool]] = {}
    names = ["level", "detector", "injected", "struck_kernel", "strike_invocation", "outcome"]
    for path in paths:
        for row in read_export(path).select(names).to_pylist():
            if (
                row["level"] == "instruction"
                and row["detector"] is None
                and row["strike_invocation"] is not None
            ):
                kernel, lost = row["struck_kernel"], row["outcome"] != "success"
                if kernel in PLANNERS:
                    first = row["strike_invocation"] == 1
                    kernel = f"planner, {'first' if first else 'later'} request"
                losses.setdefault(kernel, []).append(lost)
    whole = {name: np.array(own) for name, own in sorted(losses.items())}
    planners = {name: own for name, own in whole.items() if name.startswith("planner")}
    return {"planners": planners, "all nodes": whole}


def stratified(cells: Cells, missions: int, rng: np.random.Generator) -> tuple[Share, list[int]]:
    """Draw a stratified sample. Return its weighted share of lost missions, and the draws.

    The draws are the numbers of missions that were drawn from each stratum.
    """
    names = [*cells]
    whole = sum(map(len, cells.values()))
    sizes = [len(cells[name]) / whole for name in names]
    seen = {name: [0, 0] for name in names}
    rows: list[tuple[bool, bool, float, str]] = []
    for begin in range(0, missions, ROUND):
        size = min(ROUND, missions - begin)
        counts = allocate(sizes, [spread(*seen[name]) for name in names], size)
        for name, share, count in zip(names, sizes, counts, strict=True):
            drawn = rng.choice(cells[name], size=count)
            seen[name] = [seen[name][0] + int(drawn.sum()), seen[name][1] + count]
            rows += [(bool(hit), True, size * share / count, name) for hit in drawn]
    return weighted_share(*zip(*rows, strict=True)), [total for _, total in seen.values()]


def show(name: str, cells: Cells, missions: int, repetitions: int) -> None:
    """Print a population and its strata, and compare repeated samples of both kinds."""
    everyone = np.concatenate([*cells.values()])
    truth = float(everyone.mean())
    print(f"{name}: {len(everyone)} missions, {100 * truth:.1f} % lost")
    samples: dict[str, list[Share]] = {"uniform": [], "stratified": []}
    counts = []
    for seed in range(repetitions):
        rng = np.random.default_rng(seed)
        hits = int(rng.choice(everyone, size=missions).sum())
        samples["uniform"].append(wilson(hits, missions))
        share, count = stratified(cells, missions, rng)
        samples["stratified"].append(share)
        counts.append(count)
    for stratum, own, flown in zip(cells, cells.values(), np.mean(counts, axis=0), strict=True):
        print(
            f"  {stratum:24} {100 * len(own) / len(everyone):5.1f} % of the faults, "
            f"{own.sum():4} of {len(own):4} lost, {100 * flown / missions:5.1f} % of the draws"
        )
    for kind, shares in samples.items():
        values = np.array([share.share for share in shares])
        width = np.mean([share.high - share.low for share in shares])
        covered = np.mean([share.low <= truth <= share.high for share in shares])
        effective = np.mean([share.effective for share in shares])
        error = values.std(ddof=1) / np.sqrt(repetitions)
        print(
            f"  {kind:10} mean {100 * values.mean():.2f} +- {100 * error:.2f} %, "
            f"standard deviation {100 * values.std(ddof=1):.2f} points, "
            f"interval {100 * width:.2f} points wide, covers {100 * covered:.1f} %, "
            f"effective n {effective:.0f} of {missions}"
        )


def main() -> None:
    """Draw samples of both populations, and print the comparison."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("exports", nargs="*", type=Path, default=DEFAULT)
    parser.add_argument("--missions", type=int, default=200)
    parser.add_argument("--repetitions", type=int, default=200)
    arguments = parser.parse_args()
    for name, population in cells(arguments.exports or DEFAULT).items():
        show(name, population, arguments.missions, arguments.repetitions)


if __name__ == "__main__":
    main()
