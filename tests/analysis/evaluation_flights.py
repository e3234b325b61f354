"""Hand-made flights, so that every number of an evaluation is known beforehand."""

import pyarrow as pa

from mavfi_cli.analysis.detectors import KEY, SCHEMA, pairs_of
from mavfi_cli.campaigns.missions import Injected


def flown(outcome="success", time_s=100.0, *, alarms_s=(), struck_s=None, **more):
    """A flight; with alarms of control at these times."""
    return {
        "outcome": outcome,
        "succeeded": outcome == "success",
        "flight_time_s": time_s,
        "injected": Injected.GOLDEN.value,
        "struck_s": struck_s,
        "struck_sites": [],
        "first_bits": [],
        "crashed": False,
        "alarms": [{"stamp_s": stamp_s, "stage": "control"} for stamp_s in alarms_s],
        "alarm_count": len(alarms_s),
        "episodes": min(1, len(alarms_s)),
        "path": None,
        **more,
    }


def struck(outcome="success", time_s=100.0, *, at_s=20.0, injected=Injected.ACTIVE, **more):
    """A flight with a fault."""
    return flown(
        outcome, time_s, struck_s=at_s, injected=injected.value, struck_sites=["command_vx"],
        first_bits=[62], **more,
    )  # fmt: skip


def labelled(flight, **labels):
    """A row of a ledger's table."""
    return {f"label_{name}": labels.get(name) for name in ("kind", "detector", *KEY)} | flight


def paired(rows, detector, complete=lambda seed: True):
    """The pairs of flights: without faults, and with one."""
    found = pairs_of([pa.Table.from_pylist(rows)], [detector], complete)
    return [table.to_pylist() for table in found]


def error_free(golden=None, watched=None, *, world="dense", seed=1, detector="gad"):
    golden = golden or flown()
    mission = {"kind": "error-free", "world": world, "seed": seed}
    rows = [labelled(golden, detector="none", **mission)]
    if detector != "none":
        rows.append(labelled(watched or golden, detector=detector, **mission))
    (found,), _ = paired(rows, detector)
    return found


def pair(
    faulty, protected=None, *, golden=None, watched=None, world="dense", seed=1, detector="gad",
    complete=True,
):  # fmt: skip
    """A fault pair; without a protected flight that of the detector `none`."""
    golden = golden or flown()
    mission = {"kind": "error-free", "world": world, "seed": seed}
    fault = {
        **mission, "kind": "fault", "level": "source", "stage": "control", "target": "control",
        "field": "exponent",
    }  # fmt: skip
    rows = [
        labelled(golden, detector="none", **mission),
        labelled(faulty, detector="none", **fault),
    ]
    if protected is None:
        detector = "none"
    else:
        rows.append(labelled(watched or golden, detector=detector, **mission))
        rows.append(labelled(protected, detector=detector, **fault))
    _, (found,) = paired(rows, detector, lambda _: complete)
    return found


def table(pairs):
    """Pairs as columns."""
    return pa.Table.from_pylist(pairs, SCHEMA)
