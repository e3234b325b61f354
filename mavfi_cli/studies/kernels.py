"""`mavfi kernels`: faults in isolated kernels with the inputs of one golden flight."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from mavfi_cli.attack.kernels.target import KernelTarget
from mavfi_cli.mission.kernel_inputs import inputs_of_flight
from mavfi_cli.spec.mission import MissionConfig

WORLD, SEED = "dense", 3  # of the golden flight


def kernel_flight(world: str = WORLD, seed: int = SEED) -> MissionConfig:
    """The golden flight of the inputs.

    Collision check, planner and control have the parameters of `hardened`.
    """
    return MissionConfig(world=world, seed=seed, stack="hardened")


def kernel_targets(
    kernels: Iterable[str], config: MissionConfig, folder: Path, tolerance: float = 0.0
) -> list[KernelTarget]:
    """The kernels of these names, with the inputs of a flight.

    The flight is flown unless the folder has its inputs.

    Raises:
        ConfigError: the folder has the inputs of another flight.
    """
    fed = inputs_of_flight(config, folder)
    return [KernelTarget(kernel=each, tolerance=tolerance, **fed) for each in kernels]
