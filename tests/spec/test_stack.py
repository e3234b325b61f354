"""Stacks: their files."""

import pytest

from mavfi_cli.core.errors import ConfigError, UnknownName
from mavfi_cli.spec.stack import KEYS, STACKS, Stack, load_stack


def test_the_shipped_stacks_say_every_key_and_where_it_is_from():
    assert STACKS.names == [
        "hardened", "mavbench", "mavbench-protected", "mavbench-release", "mavbench-replica",
    ]  # fmt: skip
    mavbench = load_stack("mavbench")
    unused = {"tracking_guard_m", "farthest_waypoint_m"}
    assert set(mavbench.sources) == set(KEYS) - unused
    assert mavbench.processes == (("octomap", "collision_check", "planner"),)
    assert (mavbench.check_radius_m, mavbench.planner_radius_m) == (1.5, 2.0)


def test_the_release_differs_in_the_two_claims_only():
    paper, release = (
        load_stack("mavbench").settings_of(Stack),
        load_stack("mavbench-release").settings_of(Stack),
    )
    assert {key for key in KEYS if paper[key] != release[key]} == {
        "uses_time_to_collision", "feeds_acceleration_forward",
    }  # fmt: skip


def test_a_file_of_the_users_switches_one_key(tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text('base = "mavbench"\nguards_tracking = true\n')
    mine, base = load_stack(str(file)), load_stack("mavbench")
    assert {
        key for key in KEYS if mine.settings_of(Stack)[key] != base.settings_of(Stack)[key]
    } == {"guards_tracking"}
    assert (mine.name, mine.description) == ("mine", "")  # not those of its base
    assert mine.sources["guards_tracking"] == "set in mine.toml"  # not the base's source


def test_a_variant_is_named_by_what_differs():
    text = 'mavbench:guards_tracking=true,processes=[["octomap","planner"]]'
    variant = load_stack(text)
    assert (variant.name, variant.base, variant.guards_tracking) == (text, "mavbench", True)
    assert variant.processes == (("octomap", "planner"),)


@pytest.mark.parametrize(
    ("text", "error", "said"),
    [
        ("mavbenc", UnknownName, "did you mean 'mavbench'"),
        ("mavbench:guard=true", ConfigError, "did you mean 'guards_tracking'"),
        ("mavbench:guards_tracking", ConfigError, "must have KEY=VALUE"),
        ("mavbench:guards_tracking=1", ConfigError, "guards_tracking"),
        ("mavbench:guards_tracking=true,tracking_guard_m=0.0", ConfigError, "tracking_guard_m"),
        ("mavbench:planner_radius_m=1.0", ConfigError, "check would reject"),
        ("mavbench:stops_on_report=false", ConfigError, "into the obstacle"),
        ('mavbench:processes=[["octomap"]]', ConfigError, "at least two nodes"),
        ('mavbench:processes=[["octomap","control"]]', ConfigError, "control"),
        ('mavbench:processes=[["octomap","planer"]]', ConfigError, "no node 'planer'"),
        ("nowhere.toml", ConfigError, "no such file"),
    ],
)
def test_a_stack_that_cannot_be_is_refused_in_one_line(text, error, said):
    with pytest.raises(error, match=said) as refused:
        load_stack(text)
    assert "\n" not in str(refused.value)


def test_a_file_that_lacks_a_key_is_refused(tmp_path):
    file = tmp_path / "half.toml"
    file.write_text('name = "half"\nguards_tracking = true\n')
    with pytest.raises(ConfigError, match="missing; base = NAME takes"):
        load_stack(str(file))


def test_a_key_with_a_default_may_lack_in_an_older_file_and_changes_no_identity(tmp_path):
    plain = load_stack("hardened")
    older = tmp_path / "older.toml"
    text = (STACKS.folder / "hardened.toml").read_text()
    older.write_text(text.replace('smoother = "ours"\n', "").replace("[sources]", "\n[sources]"))
    assert "smoother" not in older.read_text()
    assert load_stack(str(older)).mark == plain.mark
    assert load_stack("hardened:smoother=release").mark.digest != plain.mark.digest
    with pytest.raises(ConfigError, match="did you mean 'release'"):
        load_stack("hardened:smoother=releas")
