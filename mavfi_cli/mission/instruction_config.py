"""What a user asks of an instruction-level fault in a mission, as plain values for the record."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

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
        target: a node, or a stage of which one node is drawn.
        seed: root of all that is drawn for the fault.
        sampling: the sampling rule. Rules by time cannot be repeated, so missions refuse them.
        compat: another injector's habits in choosing registers and bits; the moment stays drawn
            uniformly over executed instructions.
        sites, roles: which kinds of operands; empty: the usual ones.
        bits: how many distinct bits of the operand.
        null: do everything but the flip.
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

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for the record of the run."""
        return asdict(self)

    def node(self) -> str:
        """The attacked node.

        Raises:
            UnknownName: no such node or stage.
        """
        if self.target not in _NODES:
            raise UnknownName("node or stage", self.target, _NODES)
        nodes = _NODES[self.target]
        return nodes[int(generator(self.seed, Stream.FAULT, "node").integers(len(nodes)))]

    def strategy(self) -> Strategy:
        """The sampling strategy.

        Raises:
            UnknownName: a name that does not exist.
            FaultSpecError: a rule that cannot be repeated.
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

    def sampling_name(self) -> str:
        """The population, as printed beside every number."""
        if self.compat is not None:
            return f"{UNIFORM} with the operands and bits of {self.compat}"
        return self.sampling
