"""The sites that the faults of an evaluation strike, and the bits that they may flip."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

from mavfi_cli.core.errors import ConfigError
from mavfi_cli.core.seeds import Stream, derive
from mavfi_cli.core.types import DType, Stage
from mavfi_cli.fi.bits import Field
from mavfi_cli.spec.fault import FaultConfig, InstructionConfig

INTEGER = "integer"  # all bits of states that have no sign, exponent and mantissa
FIELDS = (Field.SIGN.value, Field.EXPONENT.value, Field.MANTISSA.value, INTEGER)
NODES = {
    "octomap": Stage.PERCEPTION,
    "collision_check": Stage.PERCEPTION,
    "point_cloud": Stage.PERCEPTION,
    "planner": Stage.PLANNING,
    "control": Stage.CONTROL,
}
SOURCE, INSTRUCTION = "source", "instruction"
_DRAWS = 1000  # number of fault seeds to try until one draws a state of the required type


class InjectionSite(NamedTuple):
    """Injection site of one kind of fault."""

    stage: str  # of the corrupted kernel or of its output
    target: str  # a stage, or a node
    field: str  # a bit field, `integer`, or `any`


def sites(level: str, fields: Sequence[str]) -> list[InjectionSite]:
    """Stages by bit field at source level, nodes at instruction level."""
    if level == INSTRUCTION:
        return [InjectionSite(NODES[node].value, node, Field.ANY.value) for node in NODES]
    return [
        InjectionSite(stage.value, stage.value, name)
        for stage, name in itertools.product(Stage, fields)
        if stage is not Stage.CONTROL or name != INTEGER  # its states are all float64
    ]


def fault_at(site: InjectionSite, level: str, root: int, world: str, seed: int) -> dict[str, Any]:
    """Draw the fault of a mission at a site, as settings of the mission.

    Args:
        root: root of the faults' seeds.
        world, seed: those of the mission.

    Raises:
        ConfigError: no state of the stage has this bit field.
    """
    drawn = (root, Stream.FAULT, "evaluation", world, seed, site.target, site.field)
    if level == INSTRUCTION:
        return {"instruction": InstructionConfig(target=site.target, seed=derive(*drawn))}
    whole = site.field == INTEGER
    for number in range(_DRAWS):
        fault = FaultConfig(
            target=site.target,
            field=Field.ANY.value if whole else site.field,
            seed=derive(*drawn, number),
        )
        # Draw again until the state has the required type: all of them are equally likely.
        if (fault.draw().states[0].dtype is DType.FLOAT64) is not whole:
            return {"fault": fault}
    raise ConfigError(f"no state of {site.target} has a bit field {site.field}")
