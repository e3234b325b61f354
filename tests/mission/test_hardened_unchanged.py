"""The stack `hardened` is the companion of before there were stacks: it leaves the same records.

The hashes were written by the version before stacks (commit e23d777), with the same commands but
`--stack`; that of `instruction` by commit 85c73e1, without the address where code was loaded.
"""

import sys

import pytest
from record_digest import record_digest

from mavfi_cli.mission.progress import Watcher
from mavfi_cli.mission.run import fly_mission
from mavfi_cli.spec.detector import DetectorConfig
from mavfi_cli.spec.fault import FaultConfig, InstructionConfig
from mavfi_cli.spec.mission import MissionConfig

_WAYPOINT = FaultConfig(target="planning", seed=25)
MISSIONS = {
    "golden": ({"world": "dense", "seed": 3}, "3375e55da3193c19"),
    "waypoint": ({"world": "dense", "seed": 3, "fault": _WAYPOINT}, "688e93aa6a538f52"),
    "aad": (
        {"world": "dense", "seed": 3, "fault": _WAYPOINT, "detector": DetectorConfig(name="aad")},
        "2f3f1817d13a9e55",
    ),
    "gad": (
        {
            "world": "sparse",
            "seed": 7,
            "planner": "rrtconnect",
            "fault": FaultConfig(
                target="waypoint_position", together=True, field="exponent", seed=4
            ),
            "detector": DetectorConfig(name="gad"),
        },
        "f5aba34fe9d15392",
    ),
    "held command": (
        {
            "world": "factory",
            "seed": 3,
            "planner": "rrt",
            "fault": FaultConfig(target="control", persistence="stuck-at", duration_s=3.0, seed=2),
            "detector": DetectorConfig(name="gad"),
        },
        "e158f377da14eb23",
    ),
    "tx2": (
        {
            "world": "sparse",
            "seed": 2,
            "platform": "tx2",
            "fault": FaultConfig(target="perception", at="foreseen", seed=3),
        },
        "7d64066687cf3016",
    ),
    "sequence number": (
        {"world": "farm", "seed": 5, "fault": FaultConfig(target="plan_trajectory_seq", seed=2)},
        "cd4db207e37535e6",
    ),
    "instruction": (
        {
            "world": "dense",
            "seed": 4,
            "instruction": InstructionConfig(target="control", seed=5),
        },
        "a5726c94917b6f8e",  # renewed when operands became the bits that are read or written
    ),
}


@pytest.mark.parametrize("name", MISSIONS)
def test_the_record_is_what_it_was(name, tmp_path):
    if name == "instruction" and sys.version_info[:2] != (3, 11):
        pytest.skip("the registers in the record hold addresses of another interpreter")
    values, expected = MISSIONS[name]
    folder = fly_mission(MissionConfig(stack="hardened", **values), tmp_path, Watcher())
    assert record_digest(folder.path)[:16] == expected
