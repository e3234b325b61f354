"""A fault in words, as the titles of pictures say it."""

import re

import pytest

from mavfi_cli.core.config import structure
from mavfi_cli.core.errors import ConfigError, FaultSpecError
from mavfi_cli.spec.fault import FaultConfig, InstructionConfig


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"target": "planning"}, "a bit .* planning"),
        ({"target": "command_vx", "field": "exponent"}, "an exponent bit .* command vx"),
        ({"target": "command_vx", "bits": 3, "field": "sign"}, "3 sign bits .* command vx"),
        ({"target": "command_vx", "exact_bits": (62,)}, "bit 62 .* command vx"),
        ({"target": "command_vx", "exact_bits": (1, 62)}, "bits 1 and 62 .* command vx"),
        ({"target": "command_vx", "effect": "zero"}, "command vx .* zero"),
        ({"target": "waypoint_position", "together": True}, "a bit .*each .*waypoint position"),
        ({"target": "queue.waypoint_x"}, "a bit .* waypoint x .*queue"),
        ({"target": "process.octomap"}, ".*process.* octomap .*killed"),
        ({"target": "time_to_collision", "persistence": "stuck-at", "at": "time=8"},
         "a bit .* time to collision, stuck-at, at time 8"),
    ],
)  # fmt: skip
def test_a_fault_in_a_state_in_words(changes, words):
    assert re.fullmatch(words, FaultConfig(**changes).describe())


def test_a_drawn_state_stands_for_the_stage():
    assert FaultConfig(target="planning").describe("waypoint_z").endswith("waypoint z")
    queued = FaultConfig(target="queue.waypoint_x")
    assert queued.describe("waypoint_x") == queued.describe()


def test_a_fault_in_an_instruction_in_words():
    fault = InstructionConfig(target="perception", sites=("flags",), bits=2)
    assert re.fullmatch(r"2 bits .* instruction .* perception \(flags\)", fault.describe())
    assert fault.describe("point_cloud").endswith(" point cloud (flags)")
    assert InstructionConfig(target="control", null=True).describe().startswith("no bit")


@pytest.mark.parametrize("kind", [FaultConfig, InstructionConfig])
def test_a_negative_seed_is_refused(kind):
    with pytest.raises(FaultSpecError, match=r"seed .*at least 0, got -1"):
        kind(target="planning", seed=-1)
    with pytest.raises(ConfigError, match="seed"):
        structure({"target": "planning", "seed": -1}, kind)
