"""Counters of a mission as plain values for its record."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from mavfi_cli.companion.executor import Node
from mavfi_cli.companion.pipeline import Companion
from mavfi_cli.link.images import ImageReceiver


def mission_statistics(companion: Companion | None, images: ImageReceiver) -> dict[str, Any]:
    """Return the counters of pilot, kernels, nodes and camera link; empty without a flight."""
    if companion is None:
        return {"pilot": None, "kernels": {}, "nodes": {}, "images": {}}
    nodes = companion.executor.nodes
    return {
        "pilot": asdict(companion.pilot.counters),
        "kernels": {name: _work(node) for name, node in nodes.items()},
        "nodes": {name: _ends(node) for name, node in nodes.items()},
        "images": {"received": images.received, "lost": images.lost},
    }


def plan_lines(companion: Companion | None) -> list[dict[str, Any]]:
    """Return start and waypoints, rounded to 1 mm, of the planned trajectories."""
    plans = [] if companion is None else companion.plans
    return [
        {
            "stamp_s": plan.stamp_s,
            "points_enu_m": np.round(plan.waypoints[:, 0:3], 3).tolist(),
        }
        for plan in plans
    ]


def _work(node: Node[Any, Any]) -> dict[str, Any]:
    return {
        "invocations": node.invocations,
        "dropped_inputs": node.dropped,
        "busy_s": round(node.busy_s, 9),
    }


def _ends(node: Node[Any, Any]) -> dict[str, Any]:
    """Return the crashes and hangs of a node."""
    crashes = [
        {"stamp_s": round(loss.stamp_s, 9), "how": loss.how}
        for loss in node.losses
        if not loss.hung
    ]
    hangs = sum(loss.hung for loss in node.losses)
    return {"crashes": crashes, "hangs": hangs, "restarts": node.restarts}
