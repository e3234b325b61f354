"""Which missions are compared: the same on every platform, and those of the preset fig16."""

from collections import defaultdict
from dataclasses import replace

import pytest
from made_flights import compared, on

from mavfi_cli.analysis.platforms import titles
from mavfi_cli.analysis.timeline import timeline_seed
from mavfi_cli.campaigns.specification_file import load_spec, replaced
from mavfi_cli.core.errors import ConfigError
from mavfi_cli.studies.compare import ComparePlan


def test_as_it_stands_it_is_the_preset_fig16_mission_for_mission():
    assert ComparePlan().spec().missions() == load_spec("fig16").in_worlds("many").missions()


def test_the_missions_of_two_platforms_differ_in_the_platform_only():
    plan = ComparePlan(platforms=("x86", "tx2"), inject=("planning", "waypoint_x"), missions=4,
                       detectors=("none", "gad"))  # fmt: skip
    flown = defaultdict(list)
    for mission in plan.spec().missions():
        flown[mission.config.platform].append(replace(mission.config, platform="x86"))
    assert flown["x86"] == flown["tx2"]
    assert len(flown["x86"]) == 4 * (1 + 2 * 2)  # golden; two targets without and with GAD


def test_settings_of_one_mission_share_seed_and_fault():
    plan = ComparePlan(inject=("control",), missions=3, first_seed=40)
    by_seed = defaultdict(list)
    for mission in plan.spec().missions():
        by_seed[mission.config.seed].append(mission.config)
    assert sorted(by_seed) == [40, 41, 42]
    for configs in by_seed.values():
        faults = {c.fault for c in configs if c.fault is not None}
        assert len(faults) == 1
        detectors = [c.detector.name if c.detector else None for c in configs]
        assert sorted(map(str, detectors)) == sorted(["None", "None", "gad", "aad"] * 2)
        assert sum(c.fault is None for c in configs) == 2


def test_more_missions_come_at_the_end_of_the_list():
    few, many = (ComparePlan(missions=count).spec().missions() for count in (2, 5))
    assert many[: len(few)] == few


def test_a_stack_is_that_of_every_mission_and_of_the_preset_with_it():
    plan = ComparePlan(stack="hardened")
    assert {mission.config.stack for mission in plan.spec().missions()} == {"hardened"}
    preset = replaced(load_spec("fig16").in_worlds("many"), ["stack=hardened"])
    assert plan.spec().missions() == preset.missions()
    assert plan.described().stack == "hardened"


def test_one_platform_and_no_faults_is_a_comparison_too():
    plan = ComparePlan(platforms=("tx2",), inject=(), missions=3)
    assert plan.settings == ("golden",)
    assert [m.config.fault for m in plan.spec().missions()] == [None] * 3


def test_a_bit_field_reaches_every_fault():
    missions = ComparePlan(inject=("waypoint_x",), field="sign", missions=2).spec().missions()
    fields = {m.config.fault.field for m in missions if m.config.fault}
    assert fields == {"sign"}


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"missions": 0}, "missions: .*at least 1, got 0"),
        ({"platforms": ()}, "platform: .*at least one"),
        ({"detectors": ()}, "detector: .*at least one"),
        ({"platforms": ("x86", "x86")}, "platform: .*x86 twice"),
        ({"detectors": ("gad", "none", "gad")}, "detector: .*gad twice"),
        ({"inject": ("control", "control")}, "inject: .*control twice"),
        ({"first_seed": -1}, "first_seed: .*at least 0, got -1"),
        ({"seed": -3}, "seed: .*at least 0, got -3"),
        ({"inject": (), "field": "sign"}, "field: .*without a fault, got sign"),
    ],
)
def test_a_plan_that_makes_no_sense_is_refused(changes, told):
    with pytest.raises(ConfigError, match=f"^{told}"):
        ComparePlan(**changes)


def test_two_spellings_of_one_file_are_one_platform():
    with pytest.raises(ConfigError, match=r"^platform: .*/a\.toml twice$"):
        ComparePlan(platforms=("a.toml", "./a.toml"))


def test_files_are_called_by_their_stems_unless_two_have_the_same():
    assert titles(("x86", "boards/mine.toml")) == {"x86": "x86", "boards/mine.toml": "mine"}
    assert titles(("a/mine.toml", "b/mine.toml")) == {
        "a/mine.toml": "a/mine.toml",
        "b/mine.toml": "b/mine.toml",
    }


def test_the_timeline_is_of_a_mission_that_all_fly_well_with_a_new_plan_on_the_way():
    plan = ComparePlan(missions=4)
    straight = {"replans": 0.0}
    flights = [
        *(on("x86", seed, 20.0, **straight) for seed in (1, 2)),
        *(on("x86", seed, 20.0) for seed in (3, 4)),
        *(on("tx2", seed, 21.0) for seed in (1, 2, 4)),
        on("tx2", 3, 21.0, outcome="collision"),
    ]
    assert timeline_seed(compared(flights).table, plan.platforms) == 4
    rest = [f for f in flights if f["seed"] != 4]
    assert timeline_seed(compared(rest).table, plan.platforms) == 1
    assert timeline_seed(compared([]).table, plan.platforms) is None


def test_a_platform_that_does_not_describe_itself_is_called_by_its_name(tmp_path):
    path = tmp_path / "board.toml"
    path.write_text('name = "mine"\ncores = 4\nbase = "tx2"\n')
    (told,) = ComparePlan(platforms=(str(path),), inject=()).described().platforms
    assert (told.title, told.description) == ("board", "mine")
