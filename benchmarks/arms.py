r"""Prints and draws how many missions each arm of a campaign loses to the same faults.

    python benchmarks/arms.py docs/results/hardening-part1.parquet \
        --picture docs/pictures/hardening.svg
    python benchmarks/arms.py docs/results/ablation.parquet

Reads exports of `mavfi campaign run hardening` and `ablation`. An arm is a stack with a detector. A
mission counts as lost if its fault was read and it does not end in success. All arms flew the same
faults, so their counts are paired. Intervals are Wilson's, 95 %; McNemar's exact test compares each
arm with `mavbench` alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from exported import arguments

from mavfi_cli.paper.beyond import PLAIN, Arm, arms
from mavfi_cli.paper.sources import Evidence
from mavfi_cli.stats.shares import Share


def cell(share: Share) -> str:
    """Return a share's count and total as text, which is empty if nothing was flown."""
    return f"{share.count} of {share.total}" if share.total else ""


def lines(found: Sequence[Arm]) -> list[str]:
    """Return the lines of a table with one row per arm.

    A row has the lost missions among golden flights, for each injection site and in total, and the
    p-value of McNemar's test against `mavbench` alone.
    """
    sites = list(found[0].by_site)
    titles = ["arm", "golden", *sites, "all", "p"]
    printed = [f"| {' | '.join(titles)} |", "|---" * len(titles) + "|"]
    for arm in found:
        counts = " | ".join(cell(each) for each in (arm.golden, *(arm.by_site[s] for s in sites)))
        whole = arm.lost
        told = f"{cell(whole)}, {whole.share:.0%} ({whole.low:.0%} to {whole.high:.0%})"
        p = 1.0 if arm.p_value is None else arm.p_value
        printed.append(f"| {arm.name} | {counts} | {told} | {p:.2g} |")
    return printed


def draw(found: Sequence[Arm], path: Path) -> None:
    """Draw the share of lost missions in each arm as bars with 95 % intervals, as an SVG file."""
    import matplotlib as mpl

    mpl.use("svg")
    mpl.rcParams["svg.hashsalt"] = "mavfi"
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7.0, 3.4), layout="constrained")
    names = [arm.name for arm in reversed(found)]
    for place, arm in enumerate(reversed(found)):
        whole = arm.lost
        value = 100.0 * whole.share
        watched = "#2166ac" if "AD" in arm.name else "#7f8c8d"
        colour = "#b2182b" if arm.name == PLAIN else watched
        axes.barh(place, value, color=colour, height=0.6)
        axes.errorbar(
            value, place, xerr=[[value - 100.0 * whole.low], [100.0 * whole.high - value]],
            color="black", capsize=3, linewidth=1,
        )  # fmt: skip
        axes.text(100.0 * whole.high + 1.0, place, cell(whole), va="center", fontsize=9)
    axes.set_yticks(range(len(names)), names)
    axes.set_xlabel("missions lost, % (95 % interval)")
    axes.margins(x=0.15)
    axes.set_xlim(left=0.0)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, metadata={"Date": None})


def main() -> None:
    """Read the exports, print the table, and draw the picture if requested."""
    parser = arguments(__doc__)
    parser.add_argument("--picture", type=Path, help="where to draw, as SVG")
    given = parser.parse_args()
    flights = Evidence.gather([Path(each) for each in given.parts]).flights()
    (found,) = arms(flights, every=True).values()
    print("\n".join(lines(found)))
    if given.picture is not None:
        draw(found, given.picture)


if __name__ == "__main__":
    main()
