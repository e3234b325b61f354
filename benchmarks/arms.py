r"""What each arm of a campaign loses of the same faults, as a table and a picture.

    python benchmarks/arms.py docs/results/hardening-part1.parquet \
        --picture docs/pictures/hardening.svg
    python benchmarks/arms.py docs/results/ablation.parquet

Reads exports of `mavfi campaign run hardening` and `ablation`. An arm is a stack with a detector.
Lost are missions whose fault was read and that do not end in success. All arms flew the same
faults, so their counts pair. Intervals are Wilson's, 95 %; McNemar's exact test compares each arm
with `mavbench` alone.
"""

from __future__ import annotations

import collections
from pathlib import Path

from exported import Key, Row, against, arguments, flown, key, lost, share

from mavfi_cli.stats.shares import wilson

PLAIN = "unprotected"
NAMES = {  # what a variant of mavbench switches
    "": PLAIN,
    "refuses_far_waypoints=true": "far waypoints refused",
    "guards_tracking=true": "tracking guard",
    "owns_sequence_numbers=false": "numbers that heal",
    "control_owns_queue=false": "plan sent every tick",
    "skips_endless_slices=false": "endless slices not skipped",
    "stretches_clock=false,skips_endless_slices=false": "a follower by time",
    "position_gain_per_s=0.8,climb_gain_per_s=0.8,integral_gain_per_s2=0.05,damping_gain=0.1":
        "PID with the gains of hardened",
    "shifts_path_to_vehicle=false": "path not shifted for the check",
    "stops_on_report=false,acts_on_report_once=false": "no stop, every report counts",
    "acts_on_report_once=false": "every report counts",
    "planner_radius_m=1.1,check_radius_m=0.9": "margins of 1.1 m and 0.9 m",
    "plans_in_motion=true": "plans in motion",
    "rejected_plan_pause_s=0.0": "no pause after a rejected plan",
    "goal_tolerance_m=1.0": "goal within 1 m",
    "arrives_at_rest=false": "arrives without rest",
    "turns_before_departure=false": "no turn before departure",
    "processes=[]": "a process for each node",
}  # fmt: skip
SITES = {
    "queue.waypoint_position": "position",
    "waypoint_position": "position",
    "waypoint_duration": "duration",
    "plan_trajectory_seq": "trajectory_seq",
    "plan_future_collision_seq": "future_collision_seq",
}
FAULT = ("world", "seed", "label_site")
Cells = dict[str, dict[Key, bool]]  # whether each fault lost the mission, by arm


def arm(row: Row) -> str:
    """The name of the row's arm."""
    base, _, changes = row["label_stack"].partition(":")
    name = "all four checks" if base == "mavbench-protected" else NAMES[changes]
    detector = str(row.get("label_detector") or "").upper()
    if not detector:
        return name
    return detector if name == PLAIN else f"{name} and {detector}"


def read(rows: list[Row]) -> Cells:
    """The faults that the unprotected flight has read, by arm, in the order of the campaign."""
    cells: Cells = collections.defaultdict(dict)
    active = set()
    for row in sorted(rows, key=lambda row: row["number"]):
        cells[arm(row)][key(row, FAULT)] = lost(row)
        if arm(row) == PLAIN and row["activation"] == "read":
            active.add(key(row, FAULT))
    kept = active.intersection(*(set(faults) for faults in cells.values()))
    return {name: {f: faults[f] for f in faults if f in kept} for name, faults in cells.items()}


def lines(cells: Cells, golden: list[Row]) -> list[str]:
    """A row an arm: lost of golden flights, at each site, in all; McNemar's p against none."""
    plain = cells[PLAIN]
    sites = [site for site in SITES if any(fault[2] == site for fault in plain)]
    titles = ["arm", "golden", *(SITES[site] for site in sites), "all", "p"]
    printed = [f"| {' | '.join(titles)} |", "|---" * len(titles) + "|"]
    for name, faults in cells.items():
        own = [lost(row) for row in golden if arm(row) == name]
        parts = [own, *([bad for f, bad in faults.items() if f[2] == site] for site in sites)]
        counts = " | ".join(f"{sum(each)} of {len(each)}" if each else "" for each in parts)
        whole = share(sum(faults.values()), len(faults))
        p = f"{against(plain, faults).p_value:.2g}"
        printed.append(f"| {name} | {counts} | {whole} | {p} |")
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
        colour = "#b2182b" if arm == PLAIN else "#2166ac" if "AD" in arm else "#7f8c8d"
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
    rows = flown(given.parts)
    golden = [row for row in rows if row["injected"] == "golden"]
    cells = read([row for row in rows if row["injected"] != "golden"])
    print("\n".join(lines(cells, golden)))
    if given.picture is not None:
        draw(cells, given.picture)


if __name__ == "__main__":
    main()
