"""Lists of missions, for tests and for the programs that they start."""

from mavfi_cli.campaigns.missions import PlannedMission
from mavfi_cli.spec.mission import MissionConfig


def planned(*worlds, **config):
    """A mission a world, of seeds 0, 1, 2 ..."""
    return [
        PlannedMission(
            config=MissionConfig(world=world, seed=seed, **config),
            labels={"kind": world.partition(":")[0]},
        )
        for seed, world in enumerate(worlds)
    ]
