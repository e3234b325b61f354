"""The sampling strategy of a mission's instruction-level fault."""

from __future__ import annotations

from mavfi_cli.core.errors import FaultSpecError
from mavfi_cli.fi.tracer.fault import FaultModel, Rule, Strategy
from mavfi_cli.spec.fault import UNIFORM, InstructionConfig


def mission_strategy(fault: InstructionConfig) -> Strategy:
    """Return the strategy that draws the fault.

    Raises:
        UnknownName: A name does not exist.
        FaultSpecError: The rule is not repeatable, or conflicts with the fault model.
    """
    model = FaultModel.named(
        sites=fault.sites, roles=fault.roles, field=fault.field, bits=fault.bits
    )
    strategy = Strategy.of(fault.sampling, model, compat=fault.compat)
    if fault.compat is None and strategy.rule is not Rule.INSTRUCTION:
        raise FaultSpecError(
            f"sampling by {fault.sampling} cannot be repeated; a mission's sampling must be "
            f"{UNIFORM} (`mavfi kernels` accepts both)"
        )
    return strategy
