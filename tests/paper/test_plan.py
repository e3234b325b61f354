"""The list of all items: complete, without repetition, and the same at the front when it grows."""

from dataclasses import replace

import pytest

from mavfi_cli.campaigns.missions import canonical, changes_of
from mavfi_cli.campaigns.specification_file import load_spec
from mavfi_cli.core.errors import ConfigError, UnknownName
from mavfi_cli.paper.items import (
    BY_NAME,
    ITEMS,
    LEFT_OUT,
    FlightsPlan,
    Source,
    items_named,
)

SCALE = 0.02


def missions(items=ITEMS, stack="mavbench", scale=SCALE):
    return FlightsPlan(items=items, stack=stack, scale=scale).missions()


WHOLE = missions()


def keys(missions):
    return [canonical(changes_of(each.config)) for each in missions]


@pytest.mark.parametrize("item", [each for each in ITEMS if each.preset], ids=lambda i: i.name)
def test_the_whole_list_has_the_missions_of_each_preset(item):
    flown = load_spec(item.preset).scaled(SCALE).missions()
    assert set(keys(flown)) <= set(keys(WHOLE))
    assert sorted(keys(missions([item]))) == sorted(keys(flown))


def test_shared_missions_stand_once():
    assert len(set(keys(WHOLE))) == len(WHOLE)
    apart = sum(len(load_spec(name).scaled(SCALE).missions())
                for name in {item.preset for item in ITEMS if item.preset})  # fmt: skip
    assert len(WHOLE) == 2 * 176 + 4 < apart  # two of a hundred, and one of 25 a world


def test_a_larger_scale_flies_the_smaller_one_as_well():
    larger = missions(scale=2 * SCALE)
    assert set(keys(WHOLE)) < set(keys(larger))


def test_another_stack_flies_the_same_missions():
    ours = missions(stack="hardened")
    assert {each.config.stack for each in ours} == {"hardened"}
    assert [each.config.seed for each in ours] == [each.config.seed for each in WHOLE]


def test_a_rule_changes_faults_in_instructions_only():
    rule = {"node_restart_s": 5.0, "compat": "rosfi-2021"}
    plan = FlightsPlan(items=(), stack="mavbench", scale=SCALE, **rule)
    assert plan.rule == "rosfi-2021, dead nodes back after 5 s"
    flown = plan.missions(*plan.every)
    usual = [own for own in missions(plan.every) if own.config.fault is None]
    assert len(flown) == len(usual)
    for own, other in zip(flown, usual, strict=True):
        fault = other.config.instruction
        if fault is None:
            assert own.config == other.config
        else:
            fault = replace(fault, compat="rosfi-2021")
            assert own.config == replace(other.config, instruction=fault, node_restart_s=5.0)
    with pytest.raises(ConfigError, match=r"fig8: has no faults in instructions.* table4, table5"):
        plan.named(["table4", "fig8"])
    assert "--restart=5.0 --compat=rosfi-2021" in plan.command


def test_an_item_has_a_preset_or_another_source():
    assert all(bool(item.preset) == (item.source is Source.FLIGHTS) for item in ITEMS)


def test_unknown_items_are_named():
    assert items_named([]) == ITEMS
    assert [each.name for each in items_named(["table4", "fig8"])] == ["fig8", "table4"]
    with pytest.raises(UnknownName, match="'table4'"):
        items_named(["tabel4"])
    with pytest.raises(ConfigError, match="fig1: is not an experiment"):
        items_named(["fig1"])
    assert not LEFT_OUT.keys() & BY_NAME.keys()
