"""Hand-made flights, so that every number of an evaluation is known beforehand."""

import pyarrow as pa

from mavfi_cli.analysis.detector_pairs import SCHEMA, error_free_pair, fault_pair
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


def error_free(golden=None, watched=None, *, world="dense", seed=1, detector="gad"):
    golden = golden or flown()
    return error_free_pair(world, seed, detector, golden, watched or golden)


def pair(faulty, protected=None, *, golden=None, watched=None, seed=1, complete=True, **more):
    """A fault pair; without a protected flight that of the detector `none`."""
    labels = {
        "world": "dense", "seed": seed, "level": "source", "stage": "control", "target": "control",
        "field": "exponent", "detector": "none" if protected is None else "gad", **more,
    }  # fmt: skip
    golden = golden or flown()
    return fault_pair(
        labels, golden, faulty, watched or golden, protected or faulty, complete=complete
    )


def table(pairs):
    """Pairs as columns."""
    return pa.Table.from_pylist(pairs, SCHEMA)
