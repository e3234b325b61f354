"""`mavfi stacks`: the list, one stack explained, several compared."""

import json

import pytest

from mavfi_cli.cli.inventory import _GROUPS
from mavfi_cli.spec.stack import KEYS, STACKS, load_stack


def test_every_key_is_told_once():
    assert sorted(key for keys in _GROUPS.values() for key in keys) == sorted(KEYS)


def test_the_list_has_a_line_a_stack(command_line):
    code, out, _ = command_line("stacks")
    assert code == 0
    lines = out.splitlines()
    assert [line.split()[0] for line in lines[: len(STACKS.names)]] == STACKS.names
    assert "NAME:KEY=VALUE" in out
    assert max(map(len, lines)) <= 100


@pytest.mark.parametrize("name", [*STACKS.names, "mavbench:guards_tracking=true"])
def test_one_stack_is_explained_key_by_key_with_sources(command_line, name):
    code, out, _ = command_line("stacks", name)
    assert code == 0
    told = {line.split()[0]: line.split()[1:] for line in out.splitlines() if line[:1] == " "}
    assert set(KEYS) <= set(told)
    guards = load_stack(name).guards_tracking
    assert told["guards_tracking"][0] == str(guards).lower()
    assert max(map(len, out.splitlines())) <= 100
    assert len(out.splitlines()) <= 50


def test_what_a_variant_changes_is_not_the_releases(command_line):
    out = command_line("stacks", "mavbench:guards_tracking=true")[1]
    lines = {line.split()[0]: line for line in out.splitlines() if line.startswith("  ")}
    assert lines["guards_tracking"].endswith("this variant's name")
    assert "release, common/common.cpp" in lines["stretches_clock"]


def test_stacks_are_compared_side_by_side(command_line):
    variant = "mavbench:guards_tracking=true,processes=[]"
    code, out, _ = command_line("stacks", "mavbench", variant)
    assert code == 0
    head, guards, first, *rest = out.partition("\n\n")[2].splitlines()
    assert head.split() == ["1", "2"]
    assert guards.split() == ["guards_tracking", "false", "true"]
    assert first.startswith("processes ")
    assert first.endswith(" none")
    assert all(line.startswith(" ") for line in rest)
    many = command_line("stacks", "hardened", "mavbench", "mavbench-release", variant)[1]
    assert max(map(len, many.splitlines())) <= 100
    assert "no key differs" in command_line("stacks", "mavbench", "mavbench")[1]


def test_json_has_all_of_it(command_line):
    told = json.loads(command_line("stacks", "mavbench", "hardened", "--json")[1])
    assert [each["name"] for each in told] == ["mavbench", "hardened"]
    assert set(KEYS) | {"sources", "description", "base"} <= set(told[0])


def test_an_unknown_stack_is_named(command_line):
    code, out, err = command_line("stacks", "hardend")
    assert (code, out) == (2, "")
    assert "did you mean 'hardened'" in err
