"""Measures how OctoMap's outcome shares depend on operands, rule, scans, map and resolution.

    python benchmarks/octomap_rules.py [--runs 500] [--jobs 2] [--only NAME ...]

In the paper (Fig. 6), OctoMap has under 25 % benign runs and the most silent corruptions of all
kernels. The paper states neither the input nor the operands nor how trees were compared. Each row
changes one thing with respect to `mavfi kernels --kernel octomap`. It has the shares of outcomes
with 95 % intervals, and the share of silent corruptions that a planner would see.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

from mavfi_cli.attack.campaign import Plan, run_campaign
from mavfi_cli.fi.tracer.fault import FaultModel
from mavfi_cli.mission.kernel_inputs import kernel_targets
from mavfi_cli.report.attacks import summarise
from mavfi_cli.spec.mission import MissionConfig

KERNEL = """
import numpy as np
from mavfi_cli.attack.kernels.catalogue import KERNELS, Kernel
from mavfi_cli.attack.kernels.scope import kernel_scope
from mavfi_cli.autonomy.occupancy import OccupancyMap, OccupancyParams

SCANS, EMPTY, RESOLUTION_M, LAZY = {scans}, {empty}, {resolution_m}, {lazy}


def prepare(inputs):
    world = OccupancyMap(OccupancyParams(resolution_m=RESOLUTION_M))
    clouds = (*inputs.mapped, inputs.cloud)
    insert = world._tree.insertPointCloud
    if not LAZY:
        def whole(points, origin, max_range, lazy_eval):
            insert(points, origin, max_range=max_range, lazy_eval=False)

        class Tree:
            def __getattr__(self, name, of=world._tree):
                return whole if name == "insertPointCloud" else getattr(of, name)

        world._tree = Tree()
    for cloud in () if EMPTY else clouds[:-SCANS]:
        world.insert(cloud)

    def call():
        for cloud in clouds[-SCANS:]:
            world.insert(cloud)
        payload = np.frombuffer(world.snapshot().payload, np.uint8)
        return {{"payload": payload, "tree": lambda: np.frombuffer(world.tree(), np.uint8)}}

    return call


KERNEL = Kernel(
    name="octomap", title="OctoMap", prepare=prepare, compare=KERNELS["octomap"].compare,
    repeatable=False, too_long=True, code=lambda: kernel_scope("octomap"),
)
"""
USUAL = {"scans": 1, "empty": False, "resolution_m": 0.2, "lazy": True}


def model(**named: list[str]) -> FaultModel:
    """Return the default fault model with other sites or roles."""
    defaults: dict[str, list[str]] = {"sites": [], "roles": []}
    return FaultModel.named(**(defaults | named), field="any", bits=1)


# Name: changes of the kernel, changes of the plan.
VARIANTS: dict[str, tuple[dict[str, object], dict[str, object]]] = {
    "as it is": ({}, {}),
    "destinations only": ({}, {"model": model(roles=["destination"])}),
    "sources only": ({}, {"model": model(roles=["source"])}),
    "general registers only": ({}, {"model": model(sites=["general"])}),
    "vector registers only": ({}, {"model": model(sites=["vector"])}),
    "the rule of PINFI": ({}, {"compat": "pinfi"}),
    "rosfi-2021": ({}, {"compat": "rosfi-2021"}),
    "four scans": ({"scans": 4}, {}),
    "into an empty map": ({"empty": True}, {}),
    "voxels of 0.1 m": ({"resolution_m": 0.1}, {}),
    "inner nodes and pruning": ({"lazy": False}, {}),
    "all of MAVBench's at once": (
        {"scans": 2, "empty": True, "resolution_m": 0.1, "lazy": False}, {"compat": "pinfi"},
    ),
}  # fmt: skip


def main() -> None:
    """Run all selected variants, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=500)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", action="append", choices=list(VARIANTS), default=[])
    options = parser.parse_args()
    print("| | injected | benign | crash | hang | SDC | noticeable SDC | SDC without the tree |")
    print("|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as scratch:
        flight = MissionConfig(stack="hardened")
        for name in options.only or VARIANTS:
            kernel, changes = VARIANTS[name]
            path = Path(scratch) / "octomap_rule.py"
            path.write_text(KERNEL.format(**USUAL | kernel))
            plan = replace(Plan(runs=options.runs, seed=1), **changes)
            targets = kernel_targets([str(path)], flight, Path(scratch))
            (runs,) = run_campaign(plan, targets, jobs=options.jobs)
            (told,) = summarise(plan, [runs]).as_dict()["kernels"]
            print(f"| {name} | {' | '.join(cells(told, runs.records))} |", flush=True)


def cells(told: dict, records: tuple) -> list[str]:
    """Return the cells of a row, from a variant's summary and its records."""
    outcomes = told["outcomes"]
    shares = [outcomes[name] for name in ("benign", "crash", "hang", "sdc")]
    of = outcomes["benign"]["of"]
    parts = [e["magnitude"]["parts"] for e in records if e["outcome"] == "sdc"]
    planner = sum(bool(p["missing_for_planner"] or p["added_for_planner"]) for p in parts if p)
    return [
        f"{of} of {told['runs']}",
        *(cell(share) for share in (*shares, told["sdc_noticeable"])),
        f"{100.0 * planner / of:.1f} %" if of else "-",
    ]


def cell(share: dict) -> str:
    """Return a share with its 95 % interval as text."""
    if share["share"] is None:
        return "-"
    low, high = (100.0 * edge for edge in share["wilson95"])
    return f"{100.0 * share['share']:.1f} % ({low:.1f} to {high:.1f})"


if __name__ == "__main__":
    main()
