"""Specifications: what they expand to, and what they refuse."""

import re
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

from mavfi_cli.campaigns.begin import flyable
from mavfi_cli.campaigns.specification import Keep, Sampling, Stop
from mavfi_cli.campaigns.specification_file import PRESETS, load_spec, parse_spec
from mavfi_cli.core.errors import ConfigError, MavfiError, UnknownName
from mavfi_cli.spec.stack import Stack, load_stack


def spec_of(text):
    return parse_spec(text, Path("mine.toml"))


CROSSED = """
repetitions = 3
seed = 7
first_seed = 11
keep = "sampled"
[mission]
time_limit_s = 120
[factors]
world = ["farm", "dense"]
[[setting]]
name = "golden"
[[setting]]
name = "FI"
repetitions = 2
stage = ["planning", "control"]
bits = [1, 3]
[stop]
margin = 0.1
"""


def test_factors_are_crossed_and_settings_listed():
    spec = spec_of(CROSSED)
    assert (spec.name, spec.keep, spec.stop) == ("mine", Keep.SAMPLED, Stop(margin=0.1))
    missions = spec.missions()
    cells = Counter(tuple(mission.labels.items()) for mission in missions)
    assert len(cells) == 2 + 2 * 2 * 2
    assert cells[("setting", "golden"), ("world", "farm")] == 3
    assert cells[("setting", "FI"), ("world", "dense"), ("stage", "control"), ("bits", 3)] == 2
    assert {mission.config.time_limit_s for mission in missions} == {120.0}
    assert [m.config.seed for m in missions] == sorted([11] * 10 + [12] * 10 + [13] * 2)


def test_golden_faulty_and_other_faulty_flights_of_a_repetition_are_pairs():
    missions = [m for m in spec_of(CROSSED).missions() if m.config.world == "farm"]
    by_seed = {}
    for mission in missions:
        by_seed.setdefault(mission.config.seed, []).append(mission)
    assert [len(each) for each in by_seed.values()] == [5, 5, 1]
    for each in by_seed.values():
        assert len({mission.pair for mission in each}) == 1
    assert len({mission.pair for mission in missions}) == 3


def test_a_fault_is_drawn_anew_for_each_repetition_and_place_and_for_nothing_else():
    """Else campaigns over all states would have a draw a repetition, and count it many times."""
    text = CROSSED.replace('name = "FI"', 'name = "FI"\ndetector = ["gad", "aad"]')
    text = text.replace("[factors]", '[factors]\nplatform = ["x86", "tx2"]')
    faults = [(m.config.seed, m.config.fault) for m in spec_of(text).missions() if m.config.fault]
    assert len(faults) == 2 * 2 * 2 * 2 * 2 * 2
    assert len({fault.seed for _, fault in faults}) == 4
    assert len({(seed, fault.target, fault.seed) for seed, fault in faults}) == 4


def test_several_faults_share_an_invocation_and_everything_else_is_flown_once_for_them():
    text = """
    repetitions = 6
    faults_per_invocation = 3
    [[setting]]
    name = "golden"
    [[setting]]
    name = "FI"
    level = "instruction"
    stage = ["perception", "control"]
    """
    missions = spec_of(text).missions()
    assert [mission.config.seed for mission in missions if not mission.config.instruction] == [1, 2]
    places = {}
    for mission in missions:
        if (fault := mission.config.instruction) is not None:
            key = (fault.invocation_seed, mission.config.seed, fault.target, fault.node())
            places.setdefault(key, set()).add(fault.seed)
    assert [len(seeds) for seeds in places.values()] == [3] * 4
    assert len({pair for mission in missions if (pair := mission.pair)}) == 2
    assert spec_of(spec_of(text).to_toml()) == spec_of(text)
    with pytest.raises(ConfigError, match="must be 1 with a stopping rule"):
        spec_of(f"{text}\n[stop]\nmargin = 0.1")


def test_a_user_s_companion_has_no_strata():
    text = 'sampling = "{}"\n[mission]\ncompanion = "true"\n[[setting]]\nname = "golden"\n'
    assert spec_of(text.format("uniform")).fixed["companion"] == "true"
    with pytest.raises(ConfigError, match="must be uniform with a user's companion"):
        spec_of(text.format("stratified"))
    with pytest.raises(ConfigError, match="must be uniform with a user's companion"):
        spec_of(text.format("uniform")).sampled(Sampling.STRATIFIED)


@pytest.mark.parametrize("name", ["../mine", "/mine", "a/b", "..", ".", "", "a\\nb"])
def test_a_name_that_leads_out_of_the_folder_of_campaigns_is_refused(name):
    with pytest.raises(ConfigError, match="name: must be the name of a folder"):
        spec_of(f'name = "{name}"\n{CROSSED}')


def test_the_list_is_a_function_of_the_specification():
    assert spec_of(CROSSED).missions() == spec_of(CROSSED).missions()
    other = spec_of(CROSSED.replace("seed = 7", "seed = 8", 1)).missions()
    assert other != spec_of(CROSSED).missions()
    assert [m.pair for m in other] == [m.pair for m in spec_of(CROSSED).missions()]


def test_more_repetitions_begin_with_the_same_missions():
    some = {(m.pair, str(m)) for m in spec_of(CROSSED).missions()}
    more = {(m.pair, str(m)) for m in spec_of(CROSSED.replace("= 3\nseed", "= 5\nseed")).missions()}
    assert some < more


@pytest.mark.parametrize("text", [CROSSED, "", "[factors]\nsites = [['flags'], []]\nsite = 'x'"])
def test_a_specification_comes_back_as_it_was(text):
    spec = spec_of(text)
    assert spec_of(spec.to_toml()) == spec


def test_detectors_and_what_they_protect():
    text = """
    [[setting]]
    name = "golden"
    [[setting]]
    stage = "control"
    [[setting]]
    stage = "control"
    detector = ["gad", "aad"]
    protect = [["control"], ["planning", "control"]]
    """
    golden, faulty, *protected = spec_of(text).missions()
    found = [(m.config.detector.name, m.config.detector.protect) for m in protected]
    assert found == [
        ("gad", ("control",)), ("gad", ("planning", "control")),
        ("aad", ("control",)), ("aad", ("planning", "control")),
    ]  # fmt: skip
    assert golden.config.detector is None
    assert protected[1].labels["protect"] == "planning+control"
    assert {m.pair for m in protected} == {faulty.pair} == {golden.pair}
    assert {m.config.fault for m in protected} == {faulty.config.fault}


def test_the_detector_none_is_no_detector():
    text = """
    [[setting]]
    stage = "control"
    detector = ["none", "gad"]
    """
    without, watched = spec_of(text).missions()
    assert (without.config.detector, watched.config.detector.name) == (None, "gad")
    assert (without.config.fault, without.labels["detector"]) == (watched.config.fault, "none")


def test_a_stack_is_a_factor_as_any_other():
    text = """
    [factors]
    stack = ["hardened", "mavbench:guards_tracking=true,tracking_guard_m=3.0"]
    """
    first, second = spec_of(text).missions()
    assert [m.config.stack for m in (first, second)] == [
        "hardened", "mavbench:guards_tracking=true,tracking_guard_m=3.0",
    ]  # fmt: skip
    assert second.labels["stack"] == second.config.stack
    assert first.pair != second.pair
    assert len(flyable(spec_of(text))) == 2
    with pytest.raises(MavfiError, match=r"gards: .*'guards_tracking'.*in"):
        flyable(spec_of(text.replace("guards_tracking", "gards")))


def test_a_planner_is_one_setting_however_it_is_written():
    missions = spec_of('[factors]\nplanner = ["RRT*", "rrt-connect"]').missions()
    assert [m.config.planner for m in missions] == ["rrtstar", "rrtconnect"]
    assert [m.labels["planner"] for m in missions] == ["rrtstar", "rrtconnect"]
    with pytest.raises(ConfigError, match="twice"):
        spec_of('[factors]\nplanner = ["rrtstar", "rrt-star"]')


def test_scale_leaves_at_least_one_of_each():
    spec = spec_of(CROSSED)
    assert len(spec.scaled(2.0).missions()) == 2 * len(spec.missions())
    assert len(spec.scaled(0.01).missions()) == 10
    with pytest.raises(ConfigError, match="scale"):
        spec.scaled(0.0)


def test_instruction_level_and_lists_of_values():
    text = """
    [factors]
    level = "instruction"
    site = "octomap"
    sites = [["general"], ["general", "flags"]]
    start = [1.0, 2.0, 0.0]
    """
    missions = spec_of(text).missions()
    assert [m.config.instruction.sites for m in missions] == [("general",), ("general", "flags")]
    assert {m.config.instruction.target for m in missions} == {"octomap"}
    assert {m.config.start for m in missions} == {(1.0, 2.0, 0.0)}
    assert missions[1].labels["sites"] == "general+flags"


@pytest.mark.parametrize(
    ("text", "error", "problem"),
    [
        ("[factors]\nwrld = ['farm']", ConfigError, r"factors.wrld: .*'world'"),
        ("[[setting]]\nstgae = 'control'", ConfigError, r"'stage'"),
        ("[mission]\ntime_limit = 3", ConfigError, r"'time_limit_s'"),
        ("repetition = 3", ConfigError, r"'repetitions'"),
        ("[factors]\nlink = 'udpin:1'", ConfigError, r"link: unknown key"),
        ("[factors]\nworld = []", ConfigError, r"factors.world: .*at least one"),
        ("[factors]\nbits = [1, 1]", ConfigError, r"factors.bits: .*twice"),
        ("repetitions = 0", ConfigError, r"repetitions: .*at least 1, got 0"),
        ("repetitions = true", ConfigError, r"repetitions: .*got True"),
        ("keep = 'some'", UnknownName, r"Known: all, failures, few, none"),
        ("setting = 3", ConfigError, r"setting: must be one or more"),
        ("setting = []", ConfigError, r"has no missions"),
        ("repetitions = 1_000_001", ConfigError, r"at most 1000000 missions, got 1000001"),
        (
            "repetitions = 50_001\n[factors]\nbits = [1, 2, 3, 4]\nworld = ['farm', 'dense',"
            " 'sparse', 'factory', 'train-0.05-3']",
            ConfigError,
            r"at most 1000000 missions, got 1000020",
        ),
        ("factors = 3", ConfigError, r"factors: must be a table"),
        ("name = 3", ConfigError, r"name: must be text, got 3"),
        ("seed =\nname = 'x'", ConfigError, r"mine.toml:1: "),
        ("[factors]\nbits = [{}, {}]", ConfigError, r"factors.bits: .*twice"),
        ("[factors]\nworld = [1979-05-27]", ConfigError, r"factors.world: .*date"),
        ("[mission]\nworld = 07:32:00", ConfigError, r"mission.world: .*time"),
        ("[[setting]]\nprotect = 'control'", ConfigError, r"protect: .*list, got 'cont"),
        ("[[setting]]\nprotect = ['control', ['planning']]", ConfigError, r"must be a list, got"),
        ("[mission]\nstart = 2.0", ConfigError, r"mission.start: .*list, got 2.0"),
        ("[stop]\nmargin = 0.7", ConfigError, r"stop: margin must be between"),
        ("[stop]\nmargn = 0.1", ConfigError, r"did you mean 'margin'"),
    ],
)  # fmt: skip
def test_a_bad_specification_is_refused_where_it_is_wrong(text, error, problem):
    with pytest.raises(error, match=problem):
        spec_of(text).missions()


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("seed = ['a']", r"seed"),
        ("seed = [-1]", r"seed: .*0 and 2147483647"),
        ("bits = [1]", r"bits: .*stage or a site"),
        ("level = 'source'", r"level: .*stage or a site"),
        ("stage = 'control'\nsite = 'command_yaw'", r"stage or a site .*not both"),
        ("stage = 'control'\nlevel = 'sauce'", r"level: .*source or instruction"),
        ("sites = ['waypoint_x']", r"sites: .*source level.*'site'"),
        ("level = 'instruction'\nsites = ['flags']", r"sites: .*stage or a site"),
        ("stage = 'control'\nsampling = 'cpu-time'", r"sampling: is not a factor"),
        ("stage = 'control'\nlevel = 'instruction'\neffect = 'zero'", r"^effect: is not a factor"),
        ("stage = 'control'\nbits = ['one']", r"bits: must be a whole number"),
        ("stage = 'control'\nat = 'time=301'", r"at time=301: "),
        (
            "stage = 'control'\nat = 'tick=600'\ntime_limit_s = [30.0, 11.0]",
            r"at tick=600: .* 11 s, got 12 s \(in ",
        ),
        ("v_max_mps = [99.0]", r"v_max_mps: must be between"),
        ("threshold = 2.0", r"threshold: requires a detector"),
        ("detector = 'gad'\nprotect = ['contrl']", r"did you mean 'control'"),
    ],
)
def test_a_combination_that_makes_no_mission_is_refused(text, problem):
    with pytest.raises(MavfiError, match=problem):
        spec_of(f"[factors]\n{text}").missions()


def test_what_is_wrong_with_one_of_many_settings_names_it():
    text = """
    [factors]
    world = ["farm", "sparse"]
    [[setting]]
    name = "golden"
    [[setting]]
    name = "FI"
    stage = "control"
    bits = [1, "two"]
    """
    with pytest.raises(MavfiError, match=r"^fault.* \(in setting=FI world=farm bits=two stage="):
        spec_of(text).missions()


def test_the_specification_of_the_documents_can_be_flown():
    text = Path(__file__).parents[2].joinpath("docs", "reference", "campaigns.md").read_text()
    example = text.partition("<!-- file: mine.toml -->\n```toml\n")[2].partition("```")[0]
    spec = spec_of(example)
    # two worlds x (golden, two stages x two numbers of bits: 100 each; native: 20)
    assert len(flyable(spec)) == 2 * (5 * 100 + 20)
    assert spec.stop == Stop(margin=0.05, batch=20)


@cache
def missions_of(name):
    return load_spec(name).missions()


@pytest.mark.parametrize("name", PRESETS.names)
def test_every_preset_expands_to_its_numbers(name):
    missions = missions_of(name)
    cells = Counter(tuple(sorted(m.labels.items())) for m in missions)
    repetitions = {"fig11": {25}, "fig13": {20}, "speeds": {50}, "ablation": {30, 100}}.get(
        name, {100}
    )  # paper: 100
    assert set(cells.values()) == repetitions
    sizes = {
        "fig7": 10, "fig8": 9, "fig9": 4, "table3": 4, "table4": 40, "fig11": 4, "fig13": 5,
        "fig14": 136, "fig16": 20, "speeds": 21, "hardening": 84, "ablation": 72,
        "protections": 110,
    }  # fmt: skip
    assert len(cells) == sizes[name]
    tenth = sum(round(count / 10) for count in cells.values())
    assert len(load_spec(name).scaled(0.1).missions()) == tenth


def test_the_ablation_changes_every_key_in_which_the_stacks_differ():
    paper, ours = (
        load_stack("mavbench").settings_of(Stack),
        load_stack("hardened").settings_of(Stack),
    )
    changed = set()
    for text in load_spec("ablation").axes["stack"][1:]:
        values = load_stack(text).settings_of(Stack)
        keys = set(re.findall(r"(\w+)=", text))
        assert {name for name in values if values[name] != paper[name]} == keys
        assert all(values[name] == ours[name] for name in keys)
        changed |= keys
    assert changed == {key for key in paper if paper[key] != ours[key]}


def test_hardening_has_each_protection_alone_and_all_of_them():
    plain, *single, together = map(load_stack, load_spec("hardening").axes["stack"])
    assert plain.name == "mavbench"
    protections = [
        {
            key
            for key, value in stack.settings_of(Stack).items()
            if value != plain.settings_of(Stack)[key]
        }
        for stack in single
    ]
    assert [len(keys) for keys in protections] == [1, 1, 1, 1]
    assert set.union(*protections) == {
        key for key, value in together.settings_of(Stack).items() if value != getattr(plain, key)
    }


@pytest.mark.parametrize(
    "name", sorted({*PRESETS.names} - {"hardening", "ablation", "protections"})
)
def test_the_presets_of_the_paper_fly_its_stack(name):
    assert {m.config.stack for m in missions_of(name)} == {"mavbench"}


def test_an_unknown_preset_gets_the_nearest():
    with pytest.raises(UnknownName, match="did you mean 'table4'"):
        load_spec("tabel4")
    with pytest.raises(ConfigError, match="no such file"):
        load_spec("none.toml")


def test_the_autopilot_is_a_factor():
    spec = spec_of('[factors]\nautopilot = ["ours", "px4"]\n')
    assert {mission.config.autopilot for mission in spec.missions()} == {"ours", "px4"}
