"""Hand-made flights, so that every number of an evaluation is known beforehand."""

from mavfi_cli.campaign.evaluation.pairs import Alarm, ErrorFree, FaultPair, Flown
from mavfi_cli.campaign.outcome import Injected


def flown(outcome="success", time_s=100.0, *, alarms_s=(), struck_s=None, **more):
    """A flight; with alarms of control at these times."""
    return Flown(
        outcome=outcome,
        flight_time_s=time_s,
        struck_s=struck_s,
        alarms=tuple(Alarm(stamp_s=stamp_s, stage="control") for stamp_s in alarms_s),
        alarm_count=len(alarms_s),
        episodes=min(1, len(alarms_s)),
        **more,
    )


def struck(outcome="success", time_s=100.0, *, at_s=20.0, injected=Injected.ACTIVE, **more):
    """A flight with a fault."""
    return flown(
        outcome, time_s, struck_s=at_s, injected=injected, states=("command_vx",), bits=(62,),
        **more,
    )  # fmt: skip


def error_free(golden=None, watched=None, *, world="dense", seed=1, detector="gad"):
    return ErrorFree(
        world=world, seed=seed, detector=detector, golden=golden or flown(),
        watched=watched or golden or flown(),
    )  # fmt: skip


def pair(faulty, protected=None, *, golden=None, watched=None, seed=1, **more):
    """A fault pair; without a protected flight that of the detector `none`."""
    labels = {
        "world": "dense", "level": "source", "stage": "control", "target": "control",
        "field": "exponent", "detector": "none" if protected is None else "gad", **more,
    }  # fmt: skip
    golden = golden or flown()
    return FaultPair(
        seed=seed, golden=golden, faulty=faulty, watched=watched or golden,
        protected=protected or faulty, **labels,
    )  # fmt: skip
