"""Factors that the command line replaces in a specification."""

from pathlib import Path

import pytest

from mavfi_cli.campaigns.specification_file import load_spec, parse_spec, replaced
from mavfi_cli.core.errors import ConfigError, MavfiError

SPEC = """
name = "mine"
repetitions = 2
[mission]
time_limit_s = 100.0
planner = "rrt"
[factors]
world = ["farm", "dense"]
[[setting]]
name = "golden"
[[setting]]
name = "FI"
stage = ["control", "planning"]
bits = [1, 3]
[[setting]]
name = "D&R"
stage = "control"
detector = "gad"
protect = ["control"]
"""


def changed(*changes):
    return replaced(parse_spec(SPEC, Path("mine.toml")), changes)


def test_nothing_to_replace_leaves_the_specification():
    assert changed() == parse_spec(SPEC, Path("mine.toml"))


@pytest.mark.parametrize(
    ("change", "old", "new"),
    [
        ("world=sparse", '["farm", "dense"]', '["sparse"]'),
        ("world=sparse,farm", '["farm", "dense"]', '["sparse", "farm"]'),
        ("world=1979-05-27", '["farm", "dense"]', '"1979-05-27"'),
        ("bits=5", "[1, 3]", "[5]"),
        ("time_limit_s=60", "100.0", "60"),
        ("time_limit_s=60.5", "100.0", "60.5"),
        ("v_max_mps=4", "100.0", "100.0\nv_max_mps = 4"),
        ("land=false", "100.0", "100.0\nland = false"),
        ("node_restart_s=never", "100.0", "100.0\nnode_restart_s = 3600.0"),
        ("node_restart_s=1.0,never", '"dense"]', '"dense"]\nnode_restart_s = [1.0, "never"]'),
        ("node_restart_s=1.0,never", '"dense"]', '"dense"]\nnode_restart_s = [1.0, 3600.0]'),
        ("start=1.0,2,0.0", "100.0", "100.0\nstart = [1.0, 2, 0.0]"),
        ("start=[1.0, 2, 0.0]", "100.0", "100.0\nstart = [1.0, 2, 0.0]"),
        ("stack=hardened", "100.0", '100.0\nstack = "hardened"'),
        ("stack=mavbench:guards_tracking=true", "100.0",
         '100.0\nstack = "mavbench:guards_tracking=true"'),
        ('stack="mavbench:a=true,b=1"', "100.0", '100.0\nstack = "mavbench:a=true,b=1"'),
        ('stack=["a","b:x=true,y=1"]', '"dense"]', '"dense"]\nstack = ["a", "b:x=true,y=1"]'),
        ('stack=a,"b:x=true,y=1"', '"dense"]', '"dense"]\nstack = ["a", "b:x=true,y=1"]'),
        ('protect=[["control"], ["planning"]]', 'protect = ["control"]',
         'protect = [["control"], ["planning"]]'),
        ("isolate=[[], ['octomap']]", '"dense"]', '"dense"]\nisolate = [[], ["octomap"]]'),
        ("protect=planning,control", 'protect = ["control"]', 'protect = ["planning", "control"]'),
    ],
)  # fmt: skip
def test_a_factor_is_replaced_as_if_the_file_had_it(change, old, new):
    assert SPEC.count(old) == 1
    expected = parse_spec(SPEC.replace(old, new), Path("mine.toml"))
    assert changed(change).missions() == expected.missions()


def test_several_values_of_what_all_missions_have_are_crossed():
    found = changed("planner=rrt,rrtstar")
    assert found.axes["planner"] == ("rrt", "rrtstar")
    assert "planner" not in found.fixed


def test_all_settings_that_have_it_get_it_and_no_other():
    golden, faulty, protected = changed("stage=perception").settings
    assert "stage" not in golden.axes
    assert faulty.axes["stage"] == protected.axes["stage"] == ("perception",)


def test_the_name_tells_the_changes_and_is_a_folders():
    found = changed("world=../my worlds/a.toml,dense", "bits=1,3")
    assert found.name == "mine-world=..-my-worlds-a.toml-dense-bits=1-3"
    assert replaced(load_spec("fig8"), ["world=dense"]).name == "fig8-world=dense"
    assert changed('stack=["a","b:x=true,y=1"]').name == "mine-stack=-a-b-x=true-y=1"


def test_a_long_name_ends_with_a_digest_of_the_changes():
    long = "stack=mavbench:" + ",".join(f"key_{n}=true" for n in range(30))
    names = {changed(change).name for change in (long, long.replace("true", "false"))}
    assert {len(name) for name in names} == {100}
    assert len(names) == 2


@pytest.mark.parametrize(
    ("changes", "error", "problem"),
    [
        (("wrold=dense",), ConfigError, r"wrold: .*'world'"),
        (("mission.world=dense",), ConfigError, r"mission.world: .*'world"),
        (("repetitions=3",), ConfigError, r"repetitions: unknown key"),
        (("world",), ConfigError, r"set: .*KEY=VALUE\[,VALUE\], got 'world'"),
        (("world=",), ConfigError, r"set: must be KEY=VALUE"),
        (("world=farm,farm",), ConfigError, r"factors.world: .*twice"),
        (("node_restart_s=3600.0,never",), ConfigError, r"node_restart_s: .*twice"),
        (("world=[]",), ConfigError, r"factors.world: .*at least one"),
        (("bits=1", "bits=3"), ConfigError, r"set: bits is set twice"),
        (("field=sign",), ConfigError, r"field: .*bits, detector, planner, "),
        (("seed=3",), ConfigError, r"seed: .*not a factor of this campaign"),
        (("bits=one",), ConfigError, r"bits: .*whole number"),
        (("time_limit_s=long",), ConfigError, r"time_limit_s: must be a number"),
    ],
)  # fmt: skip
def test_what_cannot_be_replaced_is_refused(changes, error, problem):
    with pytest.raises(MavfiError, match=problem) as refused:
        changed(*changes).missions()
    assert isinstance(refused.value, error)


def test_another_injector_strikes_in_all_settings_at_instruction_level():
    """Its name is no factor of the presets, but of every fault at that level."""
    plain, other = load_spec("table4"), replaced(load_spec("table4"), ["compat=rosfi-2021"])
    missions = [mission.config for mission in other.missions()]
    assert len(missions) == len(plain.missions())
    faults = [config.instruction for config in missions if config.instruction is not None]
    assert len(faults) == 3 * 1200
    assert {fault.compat for fault in faults} == {"rosfi-2021"}
    with pytest.raises(MavfiError, match="not a factor of this campaign"):
        replaced(load_spec("fig8"), ["compat=rosfi-2021"])
