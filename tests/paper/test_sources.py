"""What is found in folders, what is missing there, and what cannot be read."""

import json
import re
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from made_flights import Book, export_table, row

from mavfi_cli.analysis.flights import exported
from mavfi_cli.analysis.pairs import Fate
from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.campaigns.missions import Injected
from mavfi_cli.core.errors import RecordError
from mavfi_cli.core.installed import installed_versions
from mavfi_cli.paper.document import document
from mavfi_cli.paper.items import Regime
from mavfi_cli.paper.sources import Evidence
from mavfi_cli.report.campaign import flights_file
from mavfi_cli.report.page import render

KERNELS = Path(__file__).parents[2] / "docs/results/kernels.json"


@pytest.fixture
def campaign(tmp_path):
    """Make the folder of a campaign with planned and flown golden missions."""

    def make(name, planned, flown, versions=None):
        book, golden = Book(tmp_path / name), {"setting": "golden"}
        told = json.dumps(installed_versions() | (versions or {}))
        book.ledger.set_meta({"name": name, "versions": told})
        for seed in range(flown):
            host = {"host": {"machine": "x86_64", "cores": 4}}
            book.add(golden, seed, injected=Injected.GOLDEN, record=host)
        for seed in range(flown, planned):
            book.plan(golden, seed)
        book.ledger.close()
        return tmp_path / name

    return make


@pytest.fixture
def export(tmp_path):
    """Write an export of some rows."""

    def make(name, *rows):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(export_table(rows), path)
        return path

    return make


def test_a_whole_campaign_has_no_problems(campaign):
    found = Evidence.gather([campaign("whole", 3, 3)])
    assert found.problems == []
    (source,) = found.campaigns
    assert (source.name, source.planned, len(source.flights)) == ("whole", 3, 3)
    assert source.host["machine"] == "x86_64"
    assert source.versions == installed_versions()


def test_an_export_tells_what_its_campaign_does(campaign, tmp_path):
    folder = campaign("half", 5, 2)
    with Ledger(folder) as ledger:
        path = tmp_path / "half.parquet"
        path.write_bytes(flights_file(exported(ledger), path))
    found = [Evidence.gather([place]) for place in (folder, tmp_path / "half.parquet")]
    there, here = (each.campaigns[0] for each in found)
    assert (here.planned, here.versions, here.host) == (there.planned, there.versions, there.host)
    (problem,) = found[1].problems
    assert re.search("2 of 5 missions .*cannot fly the rest", problem)


def test_what_has_not_flown_is_told(campaign):
    (problem,) = Evidence.gather([campaign("half", 5, 2)]).problems
    assert "2 of 5 missions" in problem


def test_the_rest_of_a_reproduction_is_flown_by_naming_no_item(campaign, tmp_path):
    with Ledger(campaign("mavbench", 5, 2), writing=True) as ledger:
        ledger.set_meta({"reproduction": '{"stack": "mavbench", "scale": 0.5}'})
    (problem,) = Evidence.gather([tmp_path]).problems
    assert "2 of 5 missions" in problem
    assert (
        f"mavfi reproduce --stack mavbench --scale 0.5 --worlds many --out {tmp_path} " in problem
    )


def test_campaigns_of_several_builds_are_told(campaign, tmp_path):
    campaign("new", 1, 1)
    campaign("old", 1, 1, {"numpy": "1.0"})
    (problem,) = Evidence.gather([tmp_path]).problems
    assert "old and" in problem
    assert "numpy was" in problem
    assert "is 1.0" in problem


@pytest.mark.parametrize("damaged", ['{"numpy": [{"a": 1}]}', "[{}, {}]"])
def test_an_export_with_damaged_builds_is_told_and_the_rest_is_used(campaign, tmp_path, damaged):
    campaign("whole", 1, 1)
    with Ledger(campaign("odd", 1, 1), writing=True) as ledger:
        ledger.set_meta({"versions": damaged})
    found = Evidence.gather([tmp_path])
    assert [source.name for source in found.campaigns] == ["whole"]
    (problem,) = found.problems
    assert "odd: the provenance field 'versions' is damaged" in problem


def test_an_export_that_names_no_build_is_told(tmp_path):
    pq.write_table(export_table([row()]), tmp_path / "merged.parquet")
    (problem,) = Evidence.gather([tmp_path]).problems
    assert re.match("merged.parquet: .*builds", problem)


def test_a_build_that_is_not_this_one_is_told(campaign):
    (problem,) = Evidence.gather([campaign("old", 1, 1, {"ompl": "0.1"})]).problems
    assert "another build than this one" in problem
    assert "ompl was 0.1" in problem


def test_nothing_is_an_error(tmp_path, campaign):
    (tmp_path / "empty").mkdir()
    with pytest.raises(RecordError, match="empty: holds no campaign"):
        Evidence.gather([tmp_path / "empty"])
    with pytest.raises(RecordError, match="does not exist"):
        Evidence.gather([tmp_path / "absent"])
    with pytest.raises(RecordError, match="no mission has flown yet"):
        Evidence.gather([campaign("unflown", 4, 0)])


def test_an_empty_folder_beside_another_is_told(tmp_path, campaign):
    (tmp_path / "empty").mkdir()
    (problem,) = Evidence.gather([campaign("whole", 1, 1), tmp_path / "empty"]).problems
    assert "empty: holds no campaign" in problem


def test_what_cannot_be_read_is_told_and_the_rest_is_used(tmp_path, campaign):
    campaign("whole", 1, 1)
    (tmp_path / "torn").mkdir()
    (tmp_path / "torn" / "ledger.sqlite").write_bytes(b"SQLite format 3\0 and no more")
    (tmp_path / "other.parquet").write_bytes(b"PAR1")
    pq.write_table(export_table([row()]).select(["number", "world"]), tmp_path / "foreign.parquet")
    pq.write_table(export_table([row() | {"changes": "no json"}]), tmp_path / "odd.parquet")
    (tmp_path / "kernels.json").write_text("[]")
    found = Evidence.gather([tmp_path])
    assert len(found.campaigns) == 1
    told = "\n".join(found.problems)
    for name in ("torn", "other.parquet", "foreign.parquet", "odd.parquet", "kernels.json"):
        assert name in told
    assert "no column 'pair'" in told


@pytest.mark.parametrize("lacks", ["title", "runs", "outcomes"])
def test_a_part_of_a_summary_of_kernels_is_told(tmp_path, campaign, lacks):
    campaign("whole", 1, 1)
    summary = json.loads(KERNELS.read_text())
    if lacks == "outcomes":
        del summary["kernels"][0]["outcomes"]["crash"]
    else:
        del summary["kernels"][0][lacks]
    (tmp_path / "kernels.json").write_text(json.dumps(summary))
    found = Evidence.gather([tmp_path])
    assert len(found.campaigns) == 1
    (problem,) = found.problems
    assert "kernels.json: not a summary" in problem


@pytest.mark.parametrize("value", [3, [1, 2], {"plan": 1}, None])
def test_another_json_is_no_summary_of_kernels(tmp_path, value):
    (tmp_path / "kernels.json").write_text(json.dumps(value))
    with pytest.raises(RecordError, match=r"kernels\.json: .*wrong type"):
        Evidence.gather([tmp_path])


def test_a_campaigns_own_folders_are_no_campaigns(tmp_path, campaign, export):
    campaign("whole", 1, 1)
    export("whole/runs/0-sparse-1/trace.parquet", row())
    export("whole/world-search/found.parquet", row())
    export("whole/kernels.parquet", row())
    assert len(Evidence.gather([tmp_path]).campaigns) == 1


def test_a_campaign_may_lie_in_a_folder_of_any_name(tmp_path, campaign):
    (tmp_path / "runs").mkdir()
    campaign("runs/whole", 1, 1)
    assert len(Evidence.gather([tmp_path]).campaigns) == 1


def test_a_part_has_the_specification_beside_it(export, tmp_path):
    (tmp_path / "mine.toml").write_text("repetitions = 3\n[[setting]]\n")
    (source,) = Evidence.gather([export("mine-part2.parquet", row())]).campaigns
    assert source.spec.repetitions == 3
    assert source.planned is None
    assert len(source.digest) == 64


def test_a_kernel_in_two_places_counts_once(tmp_path):
    told = json.loads(KERNELS.read_text())
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        told["kernels"] = told["kernels"][:2]
        (tmp_path / name / "kernels.json").write_text(json.dumps(told))
        told["kernels"][0]["runs"] = 7
    found = Evidence.gather([tmp_path])
    (first, *_) = found.isolated.values()
    assert first.runs == 7
    assert len(found.problems) == 2
    assert f"both have {first.name}" in found.problems[0]
    fig6 = next(each for each in document(found).items if each.item.name == "fig6")
    assert [len(part.table.rows) for part in fig6.parts] == [2]


def test_a_mission_in_two_places_counts_once(export):
    places = [export("one.parquet", row(seed=1)), export("two.parquet", row(seed=1), row(seed=2))]
    found = Evidence.gather(places)
    assert len(found.flights()) == len(found.flights("mavbench")) == 2
    assert len(found.flights("hardened")) == 0


def test_a_stack_is_split_by_kind_of_world_only_if_it_has_both(export):
    fixed = row(seed=1, config={"world_seed": 2})
    ours = row(seed=1, config={"stack": "hardened", "world_seed": 2})
    found = Evidence.gather([export("one.parquet", row(seed=1), fixed, ours)])
    places = found.by_place(["mavbench", "hardened"])
    assert {place: len(flown) for place, flown in places.items()} == {
        "mavbench, fixed worlds": 1, "mavbench, another world for each seed": 1, "hardened": 1,
    }  # fmt: skip
    assert [Regime.of(place).stack for place in places] == ["mavbench", "mavbench", "hardened"]


def test_rules_of_restart_and_injector_are_judged_apart(export):
    never, rosfi = {"node_restart_s": 3600.0}, {"compat": "rosfi-2021"}
    table4 = {"time_limit_s": 400.0}
    rows = [row(seed=seed, config=table4) for seed in range(1, 31)]
    for seed in range(1, 31):
        mine = {"seed": seed, "instruction": True}
        rows += [
            row("planning", **mine, config=table4),
            row("planning", **mine, config={**table4, **never}, outcome="timeout"),
            row("control", **mine, config={**table4, **never}, fault=rosfi),
        ]
    rows += [row("planning", seed=1, config={**table4, **never}, outcome="timeout")]  # of a state
    found = Evidence.gather([export("one.parquet", *rows)])
    names = ["", ", dead nodes never back", ", rosfi-2021, dead nodes never back"]
    places = found.by_place(["mavbench"])
    assert [*places] == [f"mavbench{name}" for name in names]
    assert [len(flown) for flown in places.values()] == [61, 60, 60]  # with 30 golden each
    shown = document(found)
    claims = {each.claim.name: each.judgements for each in shown.claims}["table4-sparse"]
    lost = [claims[place][Fate.ALL].effect.value for place in places]
    assert lost == [0.0, 1.0, 0.0]
    golden = {each.claim.name: each for each in shown.claims}["table4-golden-sparse"]
    assert [golden.judgements[place][Fate.ALL].effect is None for place in places] == [
        False, True, True,
    ]  # fmt: skip
    (table4,) = (each for each in shown.items if each.item.name == "table4")
    assert [part.place for part in table4.parts] == [*places]
    assert "hardened" in table4.missing
    assert not any("never" in place for item in shown.items for place in item.missing)
    assert [Regime.of(place).name for place in places] == [*places]
    assert Regime.of("mavbench, fixed worlds, dead nodes never back").worlds == "fixed"


def test_a_detector_is_compared_with_the_same_fault_under_the_same_rule(export):
    never = {"node_restart_s": 3600.0}
    rows = [row(seed=seed) for seed in range(1, 31)]
    for seed in range(1, 31):
        mine = {"seed": seed, "instruction": True}
        rows += [
            row("planning", **mine),
            row("planning", **mine, config=never, outcome="timeout"),
            row("planning", **mine, config=never, detector="gad", outcome="timeout"),
        ]
    places = Evidence.gather([export("one.parquet", *rows)]).by_place(["mavbench"])
    assert places["mavbench"].balance("gad").pairs == 0
    found = places["mavbench, dead nodes never back"].balance("gad")
    assert (found.pairs, found.before, found.undone, found.caused) == (30, 30, 0, 0)


def test_a_golden_flight_with_two_restart_delays_counts_once(export):
    never = {"node_restart_s": 3600.0}
    rows = [row(), row(config=never), row("planning", instruction=True, config=never)]
    found = Evidence.gather([export("one.parquet", *rows)])
    assert len(found.flights()) == 2
    shown = document(found)  # the golden flight of the fault has the delay, too
    assert "2 missions judge" in shown.extent
    assert shown.place == "mavbench, dead nodes never back"
    assert "verdicts are those of: mavbench, dead nodes never back" in render(shown)


def test_most_faults_decide_which_rules_are_judged(export):
    rows = [row()] + [
        row("planning", seed=seed, instruction=True, config={"node_restart_s": 2.0 + delay})
        for delay in range(20)
        for seed in range(1, 3 if delay == 17 else 2)
    ]
    rules = Evidence.gather([export("one.parquet", *rows)]).flights().by_rules
    assert len(rules) == 9
    assert "dead nodes back after 19 s" in rules


@pytest.mark.parametrize(
    "damage",
    [
        {"node_restart_s": None}, {"node_restart_s": float("nan")}, {"node_restart_s": -5.0},
        {"instruction": {"compat": "fixed worlds"}}, {"instruction": {"compat": "$\\frac{$"}},
        {"instruction": []}, {"fault": "x"}, {"detector": 1},
    ],
)  # fmt: skip
def test_a_damaged_rule_is_damage(export, damage):
    damaged = row("planning", instruction=True)
    changes = json.loads(damaged["changes"]) | damage
    damaged["changes"] = json.dumps(changes)
    found = Evidence.gather([export("one.parquet", row()), export("two.parquet", damaged)])
    assert any("two.parquet: damaged" in problem for problem in found.problems)


def test_a_mission_that_could_not_begin_does_not_hide_its_flight(export):
    failed = {"state": "error", "outcome": None}
    places = [export("one.parquet", row(seed=1, **failed), row(seed=2)),
              export("two.parquet", row(seed=1))]  # fmt: skip
    found = Evidence.gather(places)
    assert len(found.flights()) == len(found.flights("mavbench")) == 2


@pytest.mark.slow
def test_flights_of_an_items_kind_serve_it_whatever_their_campaign(export):
    rows = []
    for seed in (7, 8):
        rows.append(row(seed=seed))
        for field in ("sign", "mantissa"):
            fault = {"field": field, "together": True}
            rows.append(row("waypoint_position", seed=seed, fault=fault))
    rows.append(row("waypoint_position", seed=7, fault={"field": "sign"}))  # not all components
    found = Evidence.gather([export("a.parquet", *rows)])
    shown = {
        (each.item.name, part.place): part for each in document(found).items for part in each.parts
    }
    found = shown["fig9", "mavbench"]
    counts = {line.labels[0]: line.cells[0].count for line in found.table.rows}
    assert counts == {"golden": 2, "sign": 2, "mantissa": 2}
    assert "fault_field" in found.picture.csv.partition("\n")[0]
    absent = {("fig9", "hardened"), ("table4", "mavbench"), ("fig6", "isolated kernels")}
    assert not absent & shown.keys()
    assert shown["fig15", "performance model"].picture is not None


def test_flights_without_their_golden_ones_are_said_to_show_nothing(export):
    alone = Evidence.gather([export("alone.parquet", row("planning", seed=1))])
    assert any("1 of 1 flights" in x for x in alone.problems)
    both = Evidence.gather([
        export("faults.parquet", row("planning", seed=1)), export("golden.parquet", row(seed=1)),
    ])  # fmt: skip
    assert not any("no golden flight" in problem for problem in both.problems)


def test_missions_of_another_paper_are_said_to_judge_nothing(export):
    config = {"v_max_mps": 0.6}
    rows = [row(seed=1, config=config), row("planning", seed=1, config=config)]
    found = Evidence.gather([export("slow.parquet", *rows)])
    assert any("slow.parquet: no flight" in x for x in found.problems)


def test_a_page_of_users_companions_shows_nothing_of_the_paper(export):
    config = {"companion": "fly.toml"}
    mine = {"instruction": True, "config": config}
    rows = [row(config=config, seed=seed, time_s=18.0 + seed) for seed in (1, 3)]
    rows += [row("fly/server", **mine, outcome="crash"), row("fly/server", **mine, seed=2)]
    found = Evidence.gather([export("one.parquet", *rows)])
    assert not any("golden" in problem or "paper" in problem for problem in found.problems)
    page = render(document(found))
    assert "fly/server" in page
    assert "1 of 2, 50" in page
    assert "The fault repeats and the flight does not" in page
    assert "20.00, SD 1.41" in page  # the golden flights, beside those with a fault
    assert "to the byte" not in page
    assert 'id="claims"' not in page
    assert 'id="problems"' in page
    both = Evidence.gather([export("two.parquet", *rows, row(seed=9))])
    page = render(document(both))
    assert 'id="claims"' in page
    assert "fly/server" in page


def test_flights_of_companions_do_not_choose_the_stack_of_the_page(export):
    mine = {"instruction": True, "config": {"companion": "fly.toml", "stack": "mavbench"}}
    replica = {"stack": "mavbench-replica"}
    rows = [row("fly/server", **mine, outcome="crash"), row(config=replica)]
    rows += [row("planning", instruction=True, config=replica)]
    assert document(Evidence.gather([export("one.parquet", *rows)])).place == "mavbench-replica"


def test_campaigns_of_one_name_stay_apart(export):
    rows = {
        name: row("fly/server", instruction=True, config={"companion": f"{name}.toml"})
        for name in ("a", "b")
    }
    paths = [export(f"{name}/hop.parquet", own) for name, own in rows.items()]
    assert [*document(Evidence.gather(paths)).companions] == [str(path) for path in paths]


@pytest.mark.parametrize("companion", [5, ["fly.toml"], {"a": 1}])
def test_a_companion_that_is_no_name_is_damage(export, companion):
    damaged = {"changes": json.dumps({"companion": companion})}
    found = Evidence.gather([export("one.parquet", row(seed=1)),
                             export("two.parquet", row(seed=1, **damaged))])  # fmt: skip
    assert any("two.parquet: damaged" in problem for problem in found.problems)
    assert len(found.campaigns) == 1
