"""Fixed worlds: the rule, the search, and that a campaign remembers what it has found."""

import re
import shutil
from pathlib import Path

import pytest

from mavfi_cli.campaigns import begin as beginning
from mavfi_cli.campaigns.begin import SEARCH, begin, stored_spec
from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.campaigns.missions import PlannedMission
from mavfi_cli.campaigns.specification import FixedWorld
from mavfi_cli.campaigns.specification_file import PRESETS, load_spec, parse_spec, replaced
from mavfi_cli.core.errors import ConfigError, UnknownName
from mavfi_cli.report.campaign import CampaignReport, state_lines
from mavfi_cli.spec.fault import FaultConfig
from mavfi_cli.spec.mission import MissionConfig

SPEC = """
name = "mine"
repetitions = 2
[factors]
world = ["rising", "flat"]
[fixed_world]
replans = [5, 6]
flights = 3
candidates = 9
worlds = ["rising"]
[[setting]]
name = "golden"
stack = ["hardened", "mavbench"]
[[setting]]
name = "FI"
stage = "control"
"""


def spec_of(text=SPEC):
    return parse_spec(text, Path("mine.toml"))


@pytest.fixture
def begun(campaign, monkeypatch):
    """Begin a campaign of flights that fly nothing; its stored rule and missions."""
    # No vehicle knows the worlds.
    monkeypatch.setattr(beginning, "check_kinds", lambda missions: None)

    def of(spec, **how):
        with begin(
            spec, campaign.folder, options=campaign.options, spectator=campaign.notes, **how
        ) as ledger:
            return stored_spec(ledger).fixed_world, [row[3] for row in ledger.rows()]

    return of


def test_all_missions_in_a_world_fly_the_first_candidate_that_fits(begun, campaign):
    rule, missions = begun(spec_of())
    assert rule.world_seed == {"rising": 5}
    assert rule.flown == {"rising": ((1,) * 3, (2,) * 3, (3,) * 3, (4,) * 3, (5,) * 3)}
    assert len(missions) == 2 * 2 * 3
    assert {'"world":"rising"' in each for each in missions} == {True, False}
    for each in missions:
        assert ('"world_seed":5' in each) == ('"world":"rising"' in each)
    assert campaign.notes.lines[-1] == "fixed world rising: seed 5"
    with Ledger(campaign.folder / SEARCH) as search:
        flown = [each.mission.config for each in search.results()]
    assert {config.stack for config in flown} == {"hardened"}  # the first
    assert {config.fault for config in flown} == {None}
    assert sorted({config.seed for config in flown}) == [1, 2, 3]
    told = r": rising 5 \(median 5\); .* from 1 on .* 5 to 6 times \(median of 3\)$"
    assert re.search(told, rule.describe(["rising", "flat"]))


def test_a_campaign_that_was_begun_searches_no_more(begun, campaign):
    found = begun(spec_of())
    text = (campaign.folder / "campaign.toml").read_text()
    assert parse_spec(text, Path("x.toml")).fixed_world == found[0]
    shutil.rmtree(campaign.folder / SEARCH)
    assert begun(spec_of()) == found  # the same command
    assert begun(parse_spec(text, Path("x.toml"))) == found  # the folder, or its file elsewhere
    more, missions = begun(spec_of(SPEC.replace("= 2\n", "= 3\n")), append=True)
    assert (more, len(missions)) == (found[0], 18)
    assert not (campaign.folder / SEARCH).exists()


@pytest.mark.slow
def test_an_interrupted_search_goes_on(begun, campaign):
    begun(spec_of())
    (campaign.folder / "ledger.sqlite").unlink()
    with Ledger(campaign.folder / SEARCH) as search:
        before = search.over()
    begun(spec_of())
    with Ledger(campaign.folder / SEARCH) as search:
        assert search.over() == before == 8 * 3


def test_another_rule_is_another_campaign(begun):
    begun(spec_of())
    other = spec_of(SPEC.replace("[5, 6]", "[2, 2]"))
    with pytest.raises(ConfigError, match="rule of fixed worlds"):
        begun(other)
    with pytest.raises(ConfigError, match=r"another \[fixed_world\]"):
        begun(other, append=True)


@pytest.mark.slow
def test_a_world_in_which_none_fits_is_an_error_unless_it_is_named_or_left_out(begun, campaign):
    everywhere = SPEC.replace('worlds = ["rising"]\n', "")
    told = "^fixed_world: no world seed of flat from 1 to 9 .* 0 to 0 times"
    with pytest.raises(ConfigError, match=told):
        begun(spec_of(everywhere))
    assert not (campaign.folder / "campaign.toml").exists()
    named = everywhere.replace("[[setting]]", "[fixed_world.world_seed]\nflat = 7\n[[setting]]", 1)
    rule, missions = begun(spec_of(named))
    assert rule.world_seed == {"flat": 7, "rising": 5}
    assert sum('"world_seed":7' in each for each in missions) == 6
    assert "flat 7 (named)" in rule.describe(["flat", "rising"])


def test_a_seed_of_the_mission_goes_before_the_rule(begun):
    rule, missions = begun(replaced(spec_of(), ["world_seed=4"]))
    assert rule.world_seed == {}
    assert all('"world_seed":4' in each for each in missions)


def test_other_values_of_factors_keep_the_rule(begun):
    rule, missions = begun(replaced(spec_of(), ["world=rising", "stack=mavbench"]))
    assert rule.world_seed == {"rising": 5}
    assert len(missions) == 2 * 2


@pytest.mark.parametrize(
    ("old", "new", "error", "told"),
    [
        ("replans = [5, 6]", "", ConfigError, "must have replans or world_seed"),
        ("replans = [5, 6]", "replans = [6, 5]", ConfigError, r"replans: .* got \[6, 5\]"),
        ("replans = [5, 6]", "replans = 5", ConfigError, "fixed_world.replans: "),
        ("flights = 3", "flights = 0", ConfigError, "must be at least 1"),
        (
            "flights = 3",
            "fligths = 3",
            ConfigError,
            "fixed_world.fligths: .*did you mean 'flights'",
        ),
    ],
)
def test_a_rule_that_makes_no_sense_is_refused(old, new, error, told):
    with pytest.raises(error, match=told):
        spec_of(SPEC.replace(old, new))


def test_a_world_of_the_rule_that_no_mission_flies_is_refused(tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text(SPEC.replace('worlds = ["rising"]', 'worlds = ["risin"]'))
    with pytest.raises(UnknownName, match=r"\[fixed_world\] 'risin'.* 'rising'"):
        load_spec(str(file))
    file.write_text(SPEC)
    assert load_spec(str(file)).fixed_world.worlds == ("rising",)


def test_a_named_world_that_no_mission_flies_is_refused(tmp_path):
    file = tmp_path / "mine.toml"
    named = SPEC.replace("[[setting]]", "[fixed_world.world_seed]\n{}\n[[setting]]", 1)
    file.write_text(named.format("flst = 3"))
    with pytest.raises(UnknownName, match=r"world of \[fixed_world\] 'flst'; did you mean 'flat'"):
        load_spec(str(file))
    file.write_text(named.format("dense = 3"))  # a world, but not of these missions
    with pytest.raises(UnknownName, match=r"\[fixed_world\] 'dense'"):
        load_spec(str(file))
    file.write_text(named.format("flat = 3\ndense = 10"))  # as the shipped table has it
    assert load_spec(str(file)).fixed_world.world_seed == {"flat": 3, "dense": 10}


def test_a_fixed_world_without_a_successful_golden_flight_is_named(campaign):
    def lines(*outcomes, **config):
        missions = [
            PlannedMission(config=MissionConfig(world=f"end:{outcome}", seed=seed, **config))
            for seed, outcome in enumerate(outcomes, start=1)
        ]
        with campaign.run(missions, append=True) as ledger:
            return state_lines(ledger), CampaignReport.of(ledger).as_dict().get("lost_worlds")

    assert lines("collision", "collision") == ([], None)  # another world for each seed
    own, in_json = lines("success", "collision", "collision", world_seed=4)
    assert own == in_json
    assert own == [
        "world end:collision, seed 4: no golden flight succeeded (2 flown), so faults there show "
        "nothing"
    ]
    struck = FaultConfig(target="waypoint_x")
    assert lines("timeout", world_seed=4, fault=struck) == (own, own)  # no golden flight to judge


def test_the_rule_comes_back_as_it_was():
    spec = spec_of(SPEC.replace("worlds =", 'world_seed = {"train-0.05-3" = 2}\nworlds ='))
    assert spec_of(spec.to_toml()) == spec


def test_a_candidate_whose_flights_could_not_begin_does_not_fit():
    rule = FixedWorld(replans=(0, 9), flights=2)
    assert rule.fits((1, 2))
    assert not rule.fits((1,))
    assert not rule.fits(())


def test_a_world_in_which_golden_flights_fail_is_not_chosen(begun):
    rule, _ = begun(spec_of(SPEC.replace("rising", "doomed")))
    assert rule.world_seed == {"doomed": 6}
    assert rule.flown["doomed"][4] == (5,)  # two of three golden flights have failed


def test_an_error_tells_in_how_many_worlds_golden_flights_fail(begun):
    never = SPEC.replace("rising", "doomed").replace("[5, 6]", "[20, 21]")
    with pytest.raises(ConfigError, match="in 2 of these worlds at least half of the golden"):
        begun(spec_of(never))


def test_boxes_of_a_user_are_one_world_already():
    rule = FixedWorld(replans=(0, 9))
    assert (rule.rules("dense"), rule.rules("mine.toml")) == (True, False)


def test_seeds_alone_need_no_rule(begun):
    named = "[fixed_world.world_seed]\nflat = 7\nelsewhere = 3\n[[setting]]"
    text = SPEC[: SPEC.index("[fixed_world]")] + named + SPEC[SPEC.index("[[setting]]") + 11 :]
    spec = spec_of(text)
    assert spec.describe_worlds() == "world seeds: flat 7 (named)"
    assert replaced(spec, ["world=rising"]).describe_worlds() == ""
    assert {kind.config.world_seed for kind in spec.kinds()} == {7, None}


@pytest.mark.parametrize("preset", PRESETS.names)
def test_presets_of_the_paper_fly_its_fixed_worlds(preset):
    spec = load_spec(preset)
    seeds = {kind.config.world: kind.config.world_seed for kind in spec.kinds()}
    if preset in {"fig7", "fig8", "fig9", "fig13", "fig14", "fig16", "table3", "table4"}:
        assert seeds.items() <= spec.fixed_world.world_seed.items()
        assert spec.in_worlds("fixed") == spec
        many = spec.in_worlds("many")
        assert {kind.config.world_seed for kind in many.kinds()} == {None}
        assert len(many.missions()) == len(spec.missions())
    else:
        assert {*seeds.values()} == {None}
        with pytest.raises(ConfigError, match=r"worlds: .*has no fixed worlds"):
            spec.in_worlds("many")


def test_unknown_fixed_worlds_are_refused():
    text = SPEC[: SPEC.index("[fixed_world]")] + SPEC[SPEC.index("[[setting]]") :]
    with pytest.raises(ConfigError, match="unknown fixed worlds 'papre'; did you mean 'paper'"):
        spec_of('fixed_world = "papre"\n' + text)
