"""`mavfi vpm --fly`: fly every row of the model and compare."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from mavfi_cli.analysis.flights import chosen, flights
from mavfi_cli.analysis.overhead import compute_overheads
from mavfi_cli.campaign.missions import ResultState
from mavfi_cli.campaign.progress import Spectator
from mavfi_cli.campaign.run import Options, run_campaign
from mavfi_cli.campaign.specification import Keep
from mavfi_cli.studies.beside_model import Beside, side_by_side
from mavfi_cli.studies.flight_plan import FlightPlan
from mavfi_cli.studies.redundancy_plan import RedundancyPlan, make_plans
from mavfi_cli.vpm.report import report
from mavfi_cli.vpm.schemes import DETECTORS, schemes_with

FLIGHTS = "flights"


def fly_and_report(
    plan: RedundancyPlan,
    overheads: Mapping[str, tuple[float, str]],
    options: Options,
    spectator: Spectator,
) -> dict[str, Any]:
    """The model's report, with the flights of all rows in `flights`.

    The flights and the model beside them use the given overheads, or else the paper's. The model's
    own rows use the given overheads, or else those measured in the flights.

    Args:
        overheads: per cent and source, by the detector's name.

    Raises:
        MavfiError: as `run_campaign`; a world or vehicle that does not exist.
    """
    schemes = schemes_with(overheads)
    plans = make_plans(plan, schemes, options, spectator)
    flown = {key: each for key, each in plans.items() if isinstance(each, FlightPlan)}
    missions = plan.list_of(flown)
    with run_campaign(
        missions, plan.folder / FLIGHTS, replace(options, keep=Keep.NONE), spectator, append=True
    ) as ledger:
        table = flights(ledger, missions)
        arms = {key: chosen(table, label_group=key[0], label_arm=key[1]) for key in flown}
        measured = compute_overheads(
            each.result
            for (_, scheme), arm in arms.items()
            if scheme in DETECTORS
            for each in ledger.results(arm["number"].to_pylist())
            if each.state is ResultState.FLOWN
        )
    beside = {
        key: Beside(
            plan=each,
            flights=chosen(arms[key], state=ResultState.FLOWN.value) if key in arms else None,
            errors=tuple(chosen(arms[key], state=ResultState.ERROR.value)["reason"].to_pylist())
            if key in arms
            else (),
        )
        for key, each in plans.items()
    }
    found = {name: (100.0 * each.share, each.told("--fly")) for name, each in measured.items()}
    told = report(plan.vehicles, plan.choices, schemes_with({**found, **overheads}))
    told["flights"] = {
        "worlds": list(plan.worlds),
        "missions_each": plan.missions,
        "first_seed": plan.first_seed,
        "stack": plan.stack,
        "detectors": plan.models_told,
        **side_by_side(report(plan.vehicles, plan.choices, schemes), beside, measured),
    }
    return told
