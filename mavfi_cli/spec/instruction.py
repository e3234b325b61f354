"""Configuration of an instruction-level fault in a mission, as plain values for the record."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from mavfi_cli.core.errors import FaultSpecError, UnknownName
from mavfi_cli.core.seeds import Stream, generator

if TYPE_CHECKING:
    from mavfi_cli.fi.tracer.sampling import Strategy

UNIFORM = "instruction-uniform"  # the one rule whose draws can be repeated
_NODES = {
    "perception": ("point_cloud", "octomap", "collision_check"),
    "planning": ("planner",),
    "point_cloud": ("point_cloud",),
    "octomap": ("octomap",),
    "collision_check": ("collision_check",),
    "planner": ("planner",),
    "control": ("control",),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class InstructionConfig:
    """One instruction-level fault of a mission.

    Attributes:
        target: Injection site: a node, or a stage from which a node is drawn.
        seed: Root seed of the fault's random streams.
        sampling: Sampling rule. Missions reject rules by time, which are not repeatable.
        compat: Choose registers and bits as another injector does. The time stays uniformly
            distributed over executed instructions.
        sites, roles: Kinds of operands; empty for the default.
        bits: Number of distinct bits to flip.
        null: Null injection: do everything except the flip.
    """

    target: str
    seed: int = 1
    sampling: str = UNIFORM
    compat: str | None = None
    sites: tuple[str, ...] = ()
    roles: tuple[str, ...] = ()
    field: str = "any"
    bits: int = 1
    null: bool = False

    def node(self) -> str:
        """Return the target node.

        Raises:
            UnknownName: The node or stage does not exist.
        """
        if self.target not in _NODES:
            raise UnknownName("node or stage", self.target, _NODES)
        nodes = _NODES[self.target]
        return nodes[int(generator(self.seed, Stream.FAULT, "node").integers(len(nodes)))]

    def strategy(self) -> Strategy:
        """Return the sampling strategy.

        Raises:
            UnknownName: A name does not exist.
            FaultSpecError: The rule is not repeatable.
        """
        from mavfi_cli.fi.tracer.fault import FaultModel
        from mavfi_cli.fi.tracer.sampling import Rule, strategy

        model = FaultModel.named(
            sites=self.sites, roles=self.roles, field=self.field, bits=self.bits
        )
        chosen = strategy(self.sampling, model, compat=self.compat)
        if self.compat is None and chosen.rule is not Rule.INSTRUCTION:
            raise FaultSpecError(
                f"sampling by {self.sampling} cannot be repeated; missions take "
                f"{UNIFORM}, `mavfi kernels` takes both"
            )
        return chosen

    def check(self) -> None:
        """Validate the configuration. Raises as `strategy` and `node`."""
        self.strategy()
        self.node()

    def sampling_name(self) -> str:
        """Return the name of the population, which every report states."""
        if self.compat is not None:
            return f"{UNIFORM} with the operands and bits of {self.compat}"
        return self.sampling
