"""The stack `hardened` is the companion of before there were stacks: it leaves the same records.

The hashes were written by the version before stacks (commit e23d777), with the same commands but
`--stack`. Those of `waypoint`, `aad` and `held command` are from a processor without AVX-512: BLAS
added vectors up in another way on one with it. That of `instruction` was renewed when kernels
became code of x86-64-v3 on every processor, so that all have the same instructions.
"""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from record_digest import record_digest

from mavfi_cli.core.compiled import processor_level
from mavfi_cli.mission.progress import Watcher
from mavfi_cli.mission.run import fly_mission
from mavfi_cli.spec.detector import DetectorConfig
from mavfi_cli.spec.fault import FaultConfig, InstructionConfig
from mavfi_cli.spec.mission import MissionConfig

_WAYPOINT = FaultConfig(target="planning", seed=25)
MISSIONS = {
    "golden": ({"world": "dense", "seed": 3}, "3375e55da3193c19"),
    "waypoint": ({"world": "dense", "seed": 3, "fault": _WAYPOINT}, "8e41125a2fbcb132"),
    "aad": (
        {"world": "dense", "seed": 3, "fault": _WAYPOINT, "detector": DetectorConfig(name="aad")},
        "853d94fcecb4d60d",
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
        "5acfbb618ce76a2c",
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
        "bdf8e7c4e2bfb168",
    ),
}


@pytest.mark.parametrize("name", MISSIONS)
def test_the_record_is_what_it_was(name, tmp_path):
    if name == "instruction" and sys.version_info[:2] != (3, 11):
        pytest.skip("the registers in the record hold addresses of another interpreter")
    values, expected = MISSIONS[name]
    folder = fly_mission(MissionConfig(stack="hardened", **values), tmp_path, Watcher())
    assert record_digest(folder.path)[:16] == expected


@pytest.mark.slow
@pytest.mark.skipif(processor_level() < "x86-64-v4", reason="the tests run without AVX-512 anyway")
def test_records_and_reports_are_equal_without_avx512():
    features = np._core._multiarray_umath.__cpu_features__
    dispatched = np._core._multiarray_umath.__cpu_dispatch__
    wide = [f for f in dispatched if features[f] and f.startswith(("AVX512", "X86_V4"))]
    assert wide, "this numpy has no code for AVX-512, so that nothing can be compared"
    lower = {"NPY_DISABLE_CPU_FEATURES": " ".join(wide), "OPENBLAS_CORETYPE": "Haswell"}
    reports = Path(__file__).parents[1] / "cli" / "test_records_unchanged.py"
    others = "not without_avx512"  # this test itself
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-n", "0", "-k", others, __file__, str(reports)],
        env={**os.environ, **lower},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout
