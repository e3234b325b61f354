"""What plausibility checks and detectors save, as a table and a picture.

    python benchmarks/hardening.py PARTS... --picture docs/pictures/hardening.svg

Reads exports of `mavfi campaign run hardening`. Lost are missions whose fault was read and that do
not end in success. All arms flew the same faults, so their counts pair. Intervals are Wilson's,
95 %; McNemar's exact test compares each arm with the unprotected stack.
"""

from __future__ import annotations

from pathlib import Path

from exported import Key, against, arguments, flown, key, lost, share

from mavfi_cli.stats.shares import wilson

ARMS = {  # stack and detector -> what the picture calls it
    ("mavbench", None): "unprotected",
    ("mavbench:refuses_far_waypoints=true", None): "far waypoints refused",
    ("mavbench:guards_tracking=true", None): "tracking guard",
    ("mavbench:owns_sequence_numbers=false", None): "numbers that heal",
    ("mavbench:control_owns_queue=false", None): "plan sent every tick",
    ("mavbench-protected", None): "all four checks",
    ("mavbench", "gad"): "GAD",
    ("mavbench", "aad"): "AAD",
    ("mavbench-protected", "aad"): "all four and AAD",
}
SITES = {
    "queue.waypoint_position": "position",
    "waypoint_duration": "duration",
    "plan_trajectory_seq": "trajectory_seq",
    "plan_future_collision_seq": "future_collision_seq",
}
FAULT = ("world", "seed", "label_site")
Cells = dict[str, dict[Key, bool]]  # whether each fault lost the mission, by arm


def read(parts: list[str]) -> Cells:
    """The faults that the unprotected flight has read, by arm."""
    rows = [row for row in flown(parts) if row["injected"] != "golden"]
    cells: Cells = {arm: {} for arm in ARMS.values()}
    for row in rows:
        arm = ARMS[row["label_stack"], row["label_detector"] or None]
        cells[arm][key(row, FAULT)] = lost(row)
    active = {
        key(row, FAULT)
        for row in rows
        if row["label_stack"] == "mavbench" and not row["label_detector"]
        if row["activation"] == "read"
    }
    kept = active.intersection(*(set(faults) for faults in cells.values()))
    return {arm: {f: faults[f] for f in faults if f in kept} for arm, faults in cells.items()}


def lines(cells: Cells) -> list[str]:
    """A row an arm: lost at each site, lost in all, McNemar's p against no protection."""
    plain = cells["unprotected"]
    printed = [
        f"| arm | {' | '.join(SITES.values())} | all | p |",
        "|---" * (len(SITES) + 3) + "|",
    ]
    for arm, faults in cells.items():
        by_site = [[bad for f, bad in faults.items() if f[2] == site] for site in SITES]
        p = f"{against(plain, faults).p_value:.2g}"
        counts = " | ".join(f"{sum(each)} of {len(each)}" for each in by_site)
        printed.append(f"| {arm} | {counts} | {share(sum(faults.values()), len(faults))} | {p} |")
    return printed


def draw(cells: Cells, path: Path) -> None:
    """Bars of the share of lost missions, with intervals."""
    import matplotlib as mpl

    mpl.use("svg")
    mpl.rcParams["svg.hashsalt"] = "mavfi"
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7.0, 3.4), layout="constrained")
    for place, (arm, faults) in enumerate(reversed(cells.items())):
        count, total = sum(faults.values()), len(faults)
        whole = wilson(count, total)
        value = 100.0 * whole.share
        colour = "#b2182b" if arm == "unprotected" else "#2166ac" if "AD" in arm else "#7f8c8d"
        axes.barh(place, value, color=colour, height=0.6)
        axes.errorbar(
            value, place, xerr=[[value - 100.0 * whole.low], [100.0 * whole.high - value]],
            color="black", capsize=3, linewidth=1,
        )  # fmt: skip
        axes.text(100.0 * whole.high + 1.0, place, f"{count} of {total}", va="center", fontsize=9)
    axes.set_yticks(range(len(cells)), list(reversed(cells)))
    axes.set_xlabel("missions lost, % (95 % interval)")
    axes.margins(x=0.15)
    axes.set_xlim(left=0.0)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, metadata={"Date": None})


def main() -> None:
    """Read, print, draw."""
    parser = arguments(__doc__)
    parser.add_argument("--picture", type=Path, help="where to draw, as SVG")
    given = parser.parse_args()
    cells = read(given.parts)
    print("\n".join(lines(cells)))
    if given.picture is not None:
        draw(cells, given.picture)


if __name__ == "__main__":
    main()
