"""What a summary counts where, and which missions it compares."""

import contextlib
import json
import math
import re
from dataclasses import astuple

import numpy as np
import pytest
from made_flights import Book
from scipy import stats

from mavfi_cli.analysis.failures import setting_failures
from mavfi_cli.analysis.flights import flights
from mavfi_cli.analysis.kernels import OUTCOMES
from mavfi_cli.analysis.pairs import Flights
from mavfi_cli.analysis.summary import METRICS, groups, qualities
from mavfi_cli.campaigns.begin import stopped
from mavfi_cli.campaigns.missions import Injected
from mavfi_cli.core.errors import ConfigError, RecordError, UnknownName
from mavfi_cli.core.files import plain
from mavfi_cli.fi.tracer.fault import FaultModel
from mavfi_cli.paper.status import short, shown
from mavfi_cli.report.campaign import CampaignReport, failure_lines, quality_lines
from mavfi_cli.report.setting_table import UNPAIRED
from mavfi_cli.spec.fault import FaultConfig, InstructionConfig
from mavfi_cli.spec.mission import MissionConfig

ACTIVE, GOLDEN = Injected.ACTIVE, Injected.GOLDEN
FI = {"setting": "FI", "stage": "control"}
SAVED = {"setting": "D&R", "stage": "control", "detector": "gad"}


def summary(ledger, by=()):
    return CampaignReport.of(ledger, by).summary


def fill(book):
    """Ten golden flights of 20 s; faulty ones 10 s longer, of which 3 fail; protected 2 s."""
    for seed in range(10):
        book.add({"setting": "golden"}, seed, 20.0, injected=GOLDEN)
        book.add(FI, seed, 30.0 + (seed == 9), outcome="collision" if seed < 3 else "success")
        book.add(SAVED, seed, 22.0 + (seed == 9), outcome="timeout" if seed < 1 else "success")


def test_faults_that_did_nothing_are_counted_apart(book):
    fates = [ACTIVE, Injected.UNREAD, Injected.NOT_ACTIVATED, Injected.NOT_INJECTED, Injected.NULL,
             Injected.CAUGHT]  # fmt: skip
    for seed, injected in enumerate(fates):
        outcome = "collision" if injected is ACTIVE else "success"
        book.add(FI, seed, 20.0 + seed, injected=injected, outcome=outcome)
    (cell,) = summary(book.ledger).cells
    assert (cell.success.count, cell.success.total) == (3, 4)  # the null fault is a control
    assert (cell.inactive.count, cell.inactive.total) == (2, 2)
    assert (cell.every.count, cell.every.total) == (5, 6)
    assert cell.injected == {fate.value: 1 for fate in sorted(fates, key=lambda f: f.value)}
    assert cell.metrics["flight_time_s"].value == pytest.approx(70.0 / 3.0)  # unread, null, caught
    assert cell.metrics["flight_time_s"].count == 3
    told = CampaignReport.of(book.ledger).lines()
    row = told[1]
    assert "  3/4  " in row
    assert "  83.3 %  " in row  # of all six, as the paper counts
    assert row.endswith("  2")
    assert told[3].endswith("  ended otherwise")
    assert told[4].endswith("  collision 1, not activated 1, not injected 1")


def test_a_campaign_that_was_killed_before_it_had_a_list_has_no_row(book):
    report = CampaignReport.of(book.ledger)
    empty = report.summary
    assert (empty.missions, empty.cells, empty.faults) == (0, [], [])
    assert "over" in report.lines()[0]


def test_errors_are_counted_nowhere_else(book):
    fill(book)
    book.fail({"setting": "golden"}, 99)
    golden = summary(book.ledger).cells[0]
    assert (golden.planned, golden.errors, golden.every.total) == (11, 1, 10)


def test_faults_are_held_against_the_golden_flights_of_the_same_missions(book):
    fill(book)
    faulty, saved = summary(book.ledger).faults
    assert (faulty.first, faulty.second) == ({"setting": "golden"}, FI)
    assert (faulty.success.pairs, faulty.success.only_first) == (10, 3)
    assert faulty.success.difference == pytest.approx(-0.3)
    assert faulty.success.p_value == pytest.approx(0.25)
    assert faulty.corrected_p == pytest.approx(0.5)
    assert faulty.differences["flight_time_s"].value == pytest.approx(10.0 + 1 / 7)
    assert faulty.differences["flight_time_s"].count == 7
    assert faulty.differences["replans"].value == 0.0
    assert faulty.over_own.increase == pytest.approx(11.0 / 20.0)
    assert math.isnan(faulty.over_own.recovered)
    assert saved.second == SAVED


def test_protection_is_held_against_the_same_faults_without_it(book):
    fill(book)
    (saved,) = summary(book.ledger).protection
    assert (saved.first, saved.second) == (FI, SAVED)
    assert (saved.success.only_second, saved.success.neither) == (2, 1)
    assert saved.differences["flight_time_s"].value == pytest.approx(-8.0)
    for worst in (saved.over_own, saved.over_mean):
        assert worst.recovered == pytest.approx((31.0 - 23.0) / 20.0)
        assert worst.recovered_share == pytest.approx(8.0 / 11.0)
    assert saved.over_mean.golden == 20.0


def test_the_worst_case_is_no_missions_own_length(book):
    """Missions of 10 and 30 s, and one that only the golden setting has flown so far."""
    for seed, time_s in enumerate((10.0, 30.0)):
        book.add({"setting": "golden"}, seed, time_s, injected=GOLDEN)
        book.add(FI, seed, time_s)
    book.add({"setting": "golden"}, 2, 100.0, injected=GOLDEN)
    (faulty,) = summary(book.ledger).faults
    assert faulty.over_own.increase == 0.0
    assert faulty.over_mean.golden == 20.0
    told = CampaignReport.of(book.ledger).lines()
    assert told[-2].endswith("  worst over own golden")
    assert told[-1].endswith("  +0.0 %")


def test_what_protection_recovers_is_of_each_missions_own_golden_flight(book):
    """The short mission's fault costs most; the long mission is the longest flight throughout."""
    for seed, (golden_s, faulty_s, saved_s) in enumerate([(10.0, 20.0, 12.0), (30.0, 33.0, 30.0)]):
        book.add({"setting": "golden"}, seed, golden_s, injected=GOLDEN)
        book.add(FI, seed, faulty_s)
        book.add(SAVED, seed, saved_s)
    book.add({"setting": "golden"}, 2, 20.0, injected=GOLDEN, outcome="timeout")
    book.add(FI, 2, 99.0)  # without a golden flight to be held against
    book.add(SAVED, 2, 98.0)
    book.add({"setting": "golden"}, 3, 20.0, injected=GOLDEN)
    book.add(FI, 3, 20.0, outcome="collision")  # a flight of its protection is still a pair
    book.add(SAVED, 3, 26.0)
    (saved,) = summary(book.ledger).protection
    assert saved.over_own.increase == pytest.approx(1.0)
    assert saved.over_own.protected_worst == pytest.approx(1.3)
    assert saved.over_own.recovered_share == pytest.approx(0.7)
    assert (saved.over_mean.golden, saved.over_mean.golden_worst) == (20.0, 30.0)
    assert (saved.over_mean.faulty_worst, saved.over_mean.protected_worst) == (33.0, 30.0)
    assert saved.over_mean.recovered_share == pytest.approx(3.0 / 13.0)
    told = [re.split("  +", line)[-1] for line in CampaignReport.of(book.ledger).lines()]
    assert told[-5:-3] == ["worst over own golden", "+100.0 %, recovered 70.0 points, 70.0 %"]
    assert told[-2:] == ["worst over mean golden", "+65.0 %, recovered 15.0 points, 23.1 %"]


def test_a_group_without_what_it_is_gathered_by_is_named(book):
    fill(book)
    names = [cell.name for cell in summary(book.ledger, ["stage"]).cells]
    assert names == ["golden", "stage=control"]
    assert summary(book.ledger, ["detector"]).cells[0].name == "no detector"
    assert summary(book.ledger, ["setting", "stage"]).cells[0].name == "setting=golden"
    assert CampaignReport.of(book.ledger, ["stage"]).lines()[1].startswith("golden ")


def test_means_are_called_means(book):
    fill(book)
    text = "\n".join(CampaignReport.of(book.ledger).lines())
    assert text.count("  mean ") >= 4


def test_no_line_is_wider_than_a_screen_and_common_labels_are_told_once(book):
    for world in ("dense", "sparse"):
        for seed in range(3):
            common = {"world": world, "level": "instruction", "together": True}
            book.add({"setting": "golden", "world": world}, seed, 20.0, injected=GOLDEN)
            book.add({"setting": "FI", "stage": "control", **common}, seed, 22.0 + seed)
            labels = {"setting": "D&R(G)", "detector": "gad", "stage": "control", **common}
            book.add(labels, seed, 21.0, outcome="collision" if seed else "success")
    found = groups(book.ledger)
    told = CampaignReport.of(book.ledger).lines()
    told += quality_lines(qualities(found))
    assert max(map(len, told)) <= 100
    assert told[0].endswith(": detector=gad level=instruction stage=control together=true")
    assert told[1].split()[:3] == ["setting", "world", "over"]
    assert told[4].split()[:4] == ["D&R(G)", "dense", "3/3", "1/3"]
    assert sum("collision 2" in line for line in told) == 2
    assert sum("level" in line for line in told) == 1


def test_a_label_that_alone_tells_settings_apart_has_a_column(book):
    book.add({"setting": "FI"}, 1, 20.0)
    book.add({"setting": "FI", "field": "sign"}, 1, 21.0)
    told = CampaignReport.of(book.ledger).lines()
    assert told[0].endswith(": setting=FI")
    assert [line.split()[0] for line in told[1:4]] == ["field", "1/1", "sign"]


def test_gathered_protected_flights_meet_the_same_fault_though_another_did_nothing(book):
    for seed in range(5):
        book.add({"setting": "golden"}, seed, 20.0, injected=GOLDEN)
        for stage, idle, time_s in (("planning", seed == 0, 30.0), ("control", False, 50.0)):
            fate = Injected.NOT_INJECTED if idle else ACTIVE
            book.add({"setting": "FI", "stage": stage}, seed, time_s, injected=fate)
            book.add({"setting": "D&R", "stage": stage, "detector": "gad"}, seed, time_s)
    (saved,) = summary(book.ledger, ["setting"]).protection
    assert (saved.first, saved.second) == ({"setting": "FI"}, {"setting": "D&R"})
    assert saved.success.pairs == 9
    time = saved.differences["flight_time_s"]
    assert (time.value, time.low, time.high) == (0.0, 0.0, 0.0)


def test_the_detector_none_watches_nothing(book):
    """An evaluation of detectors labels its bare flights so."""
    for seed in range(4):
        book.add({"kind": "golden", "detector": "none"}, seed, 20.0, injected=GOLDEN)
        book.add({"kind": "fault", "detector": "none"}, seed, 22.0)
    (faulty,) = summary(book.ledger).faults
    assert faulty.success.pairs == 4


def test_settings_are_gathered_by_labels(book):
    for seed in range(4):
        book.add({"setting": "FI", "stage": "planning", "world": "farm"}, seed, 20.0)
        book.add({"setting": "FI", "stage": "control", "world": "farm"}, seed, 21.0)
        book.add({"setting": "FI", "stage": "control", "world": "dense"}, seed, 22.0)
    cells = summary(book.ledger, ["setting", "world"]).cells
    assert [(cell.labels["world"], cell.success.total) for cell in cells] == [
        ("farm", 8), ("dense", 4),
    ]  # fmt: skip
    assert cells[0].labels == {"setting": "FI", "world": "farm"}
    with pytest.raises(UnknownName, match="did you mean 'world'"):
        summary(book.ledger, ["wrld"])


def test_a_faulty_mission_pairs_with_no_golden_flight_of_another_seed(book):
    book.add({"setting": "golden"}, 1, 20.0, injected=GOLDEN)
    book.add(FI, 2, 30.0)
    assert summary(book.ledger).faults == []


def test_the_text_tells_the_numbers_and_json_has_no_nan(book):
    fill(book)
    report = CampaignReport.of(book.ledger)
    text = "\n".join(report.lines())
    assert ": detector=gad stage=control" in text
    assert "7/10" in text
    assert "collision 3" in text
    assert "recovered 40.0 points, 72.7 %" in text
    assert json.loads(json.dumps(plain(report.as_dict()), allow_nan=False))["missing"] == 0


def test_a_campaign_that_has_just_begun_has_a_table(book):
    book.plan({}, 1)
    assert "all missions" in "\n".join(CampaignReport.of(book.ledger).lines())


def test_quality_has_intervals_and_extremes_of_every_metric(book):
    fill(book)
    found = qualities(groups(book.ledger))
    assert [each.metric for each in found[::3]] == [*METRICS]
    golden, faulty, _ = found[:3]
    assert (golden.mean.value, golden.difference) == (20.0, None)
    assert (faulty.least, faulty.median, faulty.most) == (30.0, 30.0, 31.0)
    assert faulty.mean.count == 7
    assert faulty.mean.value == pytest.approx(30.0 + 1 / 7)
    assert 30.0 <= faulty.mean.low < faulty.mean.value < faulty.mean.high <= 31.0
    assert faulty.difference.value == pytest.approx(10.0 + 1 / 7)
    text = "\n".join(quality_lines(found))
    assert "+10.14" in text
    assert "replans" in text


def test_quality_without_a_success_is_no_number(book):
    book.add(FI, 1, 30.0, outcome="collision")
    found = qualities(groups(book.ledger))
    assert all(math.isnan(each.most) for each in found)
    assert quality_lines(found)[3].split()[-5:] == ["0", "-", "-", "-", "-"]


def test_failures_are_of_missions_that_succeed_without_the_fault(book):
    fill(book)
    for seed, injected, golden in (
        (20, ACTIVE, "collision"),  # it fails anyway
        (21, Injected.NOT_ACTIVATED, "success"),  # a fault of the kernel that was benign
        (22, Injected.NOT_INJECTED, "success"),  # no fault
    ):
        book.add({"setting": "golden"}, seed, 20.0, injected=GOLDEN, outcome=golden)
        outcome = "collision" if injected is ACTIVE else "success"
        book.add(FI, seed, 20.0, injected=injected, outcome=outcome)
    faulty, saved = setting_failures(book.ledger, groups(book.ledger), upsets_per_hour=2.0)
    assert (faulty.labels, faulty.failure.count, faulty.failure.total) == (FI, 3, 11)
    assert (saved.failure.count, saved.failure.total) == (1, 10)
    assert faulty.per_hour == pytest.approx((6 / 11, 2 * faulty.failure.low,
                                             2 * faulty.failure.high))  # fmt: skip
    assert faulty.layers is None
    assert re.search(r"3 of 11 .* 27\.3 %", "\n".join(failure_lines([faulty])))


# Flights that do not repeat -----------------------------------------------------------------------

HOP = {"setting": "golden", "who": "hop"}
HOP_FI, HOP_SAVED = ({"setting": name, "site": "vx"} for name in ("FI", "D&R"))


def hop(seed, *, fault=True):
    """A mission of a user's companion."""
    vx = FaultConfig(target="SET_POSITION_TARGET_LOCAL_NED.vx", seed=seed) if fault else None
    return MissionConfig(seed=seed, companion="hop.toml", fault=vx)


def fill_companion(book, order=range(12)):
    """Golden flights of 20 and 22 s by turns, one lost; faulty ones of 30 s, 6 lost; saved 2."""
    for seed, place in enumerate(order):
        book.add(HOP, seed, 20.0 + 2 * (seed % 2), injected=GOLDEN, config=hop(seed, fault=False),
                 outcome="timeout" if seed == 11 else "success")  # fmt: skip
        book.add(HOP_FI, seed, 30.0 + place % 3, outcome="crash" if place < 6 else "success",
                 config=hop(seed))  # fmt: skip
        book.add({**HOP_SAVED, "detector": "gad"}, seed, 21.0 + place % 2, config=hop(seed),
                 outcome="failsafe" if place < 2 else "success")  # fmt: skip


def test_flights_that_do_not_repeat_are_independent_samples(book):
    fill_companion(book)
    found = summary(book.ledger)
    assert found.faults == found.protection == []
    faulty, saved = found.unpaired_faults
    assert (faulty.first, faulty.second) == (HOP, HOP_FI)
    assert (faulty.first_success.counts, faulty.second_success.counts) == ("11 of 12", "6 of 12")
    assert faulty.p_value == pytest.approx(stats.fisher_exact([[11, 1], [6, 6]]).pvalue)
    assert faulty.corrected_p == pytest.approx(2 * faulty.p_value)
    assert faulty.difference.value == pytest.approx(-5 / 12)
    golden_s = [20.0 + 2 * (seed % 2) for seed in range(11)]
    faulty_s = [30.0 + seed % 3 for seed in range(6, 12)]
    ends = stats.ttest_ind(faulty_s, golden_s, equal_var=False).confidence_interval()
    time = faulty.differences["flight_time_s"]
    assert (time.low, time.high) == pytest.approx(tuple(ends))
    assert faulty.golden == faulty.first_success
    assert faulty.golden_deviation["flight_time_s"] == pytest.approx(np.std(golden_s, ddof=1))
    assert saved.golden == faulty.golden
    (protection,) = found.unpaired_protection
    assert (protection.first, protection.difference.value) == (HOP_FI, pytest.approx(4 / 12))
    assert protection.golden == faulty.golden


def test_no_number_of_flights_that_do_not_repeat_depends_on_the_pairs(book, tmp_path):
    other = Book(tmp_path / "other")
    fill_companion(book)
    fill_companion(other, reversed(range(12)))
    with contextlib.closing(other.ledger):
        ours, theirs = (
            [
                (
                    row.p_value,
                    *astuple(row.difference),
                    *astuple(row.differences["flight_time_s"]),
                    row.golden_deviation["flight_time_s"],
                )
                for row in (*found.unpaired_faults, *found.unpaired_protection)
            ]
            for found in (summary(book.ledger), summary(other.ledger))
        )
        assert len(ours) == 3
        assert ours == [pytest.approx(row) for row in theirs]


def test_a_mixed_campaign_compares_each_kind_in_its_own_way(book):
    fill(book)
    fill_companion(book)
    found = summary(book.ledger)
    assert [row.second for row in found.faults] == [FI, SAVED]
    assert [row.success.pairs for row in (*found.faults, *found.protection)] == [10, 10, 10]
    assert [row.second["site"] for row in found.unpaired_faults] == ["vx", "vx"]
    merged = summary(book.ledger, ["setting"])
    assert [row.success.pairs for row in merged.faults] == [10, 10]
    assert [row.second_success.total for row in merged.unpaired_faults] == [12, 12]
    assert [row.success.total for row in merged.cells] == [22, 22, 22]
    told = CampaignReport.of(book.ledger).lines()
    assert told.count(UNPAIRED) == 1
    assert max(map(len, told)) <= 100


def test_quality_is_held_against_all_golden_flights_that_do_not_repeat(book):
    fill(book)
    fill_companion(book)
    times = [row for row in qualities(groups(book.ledger)) if row.metric == METRICS[0]]
    by_labels = {row.name: row.difference for row in times}
    assert by_labels["setting=FI stage=control"].count == 7
    assert by_labels["setting=FI site=vx"].count == 6
    merged = qualities(groups(book.ledger, ["setting"]))
    assert {row.difference for row in merged} == {None}  # flights of both kinds


def test_failures_of_flights_that_do_not_repeat_stand_beside_those_of_all_golden_ones(book):
    fill_companion(book)
    faulty, _ = setting_failures(book.ledger, groups(book.ledger), upsets_per_hour=2.0)
    assert (faulty.failure.counts, faulty.golden.counts) == ("6 of 12", "1 of 12")
    excess = faulty.failure.minus(faulty.golden)
    assert faulty.per_hour == pytest.approx((2 * 5 / 12, 2 * max(0, excess.low), 2 * excess.high))
    assert "1 of 12 golden flights" in "\n".join(failure_lines([faulty]))


def test_flights_that_do_not_repeat_have_no_golden_flight_of_their_own(book):
    fill(book)
    fill_companion(book)
    table = Flights.of(flights(book.ledger))
    assert table.numbers("own_flight_time_s").shape == (66,)
    assert len(table.known("own_flight_time_s")) == 30
    assert sum(lost is not None for lost in table["bare_lost"]) == 30


def test_the_short_table_has_the_spread_of_flights_that_do_not_repeat(book):
    fill_companion(book)
    table, _ = shown(book.ledger)
    golden, faulty, _ = short(table).rows
    assert golden.cells[-1].value == pytest.approx(np.std([20, 22] * 5 + [20], ddof=1))
    assert faulty.cells[-1].value == pytest.approx(np.std([0, 1, 2] * 2, ddof=1))
    assert UNPAIRED in table.notes


def native(book, seeds, **fault):
    """A golden and an instruction-level mission of each seed; every second fault is fatal."""
    for seed in seeds:
        book.add({"setting": "golden"}, seed, 20.0, injected=GOLDEN)
        config = MissionConfig(
            seed=seed, instruction=InstructionConfig(target="octomap", seed=seed, **fault)
        )
        outcome = "collision" if seed % 2 else "success"
        book.add({"setting": "native"}, seed, 20.0, outcome=outcome, config=config)


def kernels_folder(tmp_path, **changes):
    """What `mavfi kernels` leaves: of 100 faults in octomap 80 corrupt its output in silence."""
    plan = {
        "rule": "instruction-uniform", "compat": None, "model": FaultModel().to_json(), **changes
    }  # fmt: skip
    plan |= {"seed": 1, "flight": "golden"}
    shares = {name: {"count": 0, "of": 100, "share": 0.0, "wilson95": [0, 1]} for name in OUTCOMES}
    shares["sdc"] |= {"count": 80, "share": 0.8}
    kernels = [{"kernel": "octomap", "title": "OctoMap", "runs": 100, "outcomes": shares}]
    text = json.dumps({"plan": plan, "kernels": kernels})
    (tmp_path / "kernels.json").write_text(text)
    return tmp_path


def test_failure_given_a_kernels_corruption(book, tmp_path):
    native(book, range(10))
    (row,) = setting_failures(book.ledger, groups(book.ledger), kernels_folder(tmp_path))
    assert row.kernel == "octomap"
    assert row.layers.corruption.share == 0.8
    assert row.layers.failure_given_corruption[0] == pytest.approx(0.5 / 0.8)
    assert "failure given corruption 0.625 (" in "\n".join(failure_lines([row]))


def test_no_setting_to_count_failures_of_is_told():
    assert "none: no setting" in failure_lines([])[-1]


def test_kernels_that_other_faults_struck_are_refused(book, tmp_path):
    native(book, range(2), bits=3)
    with pytest.raises(ConfigError, match=r"kernels.json: its faults"):
        setting_failures(book.ledger, groups(book.ledger), kernels_folder(tmp_path))


COUNTLESS = """{"plan": {"rule": "", "compat": null, "model": {}},
"kernels": [{"kernel": "octomap", "outcomes": {"sdc": {"of": 100}}}]}"""


@pytest.mark.parametrize("text", [None, "no json", "{}", '{"plan": [], "kernels": []}', COUNTLESS])
def test_a_folder_without_kernels_is_refused(book, tmp_path, text):
    native(book, range(2))
    if text is not None:
        (tmp_path / "kernels.json").write_text(text)
    with pytest.raises(RecordError, match=r"kernels.json: "):
        setting_failures(book.ledger, groups(book.ledger), tmp_path)


def test_settings_that_their_rule_has_stopped_are_named(book):
    assert stopped(book.ledger) == []  # a program made the list
    text = "repetitions = 40\n[stop]\nmargin = 0.1\nbatch = 20\n"
    book.ledger.set_meta({"spec": text, "name": "stopping"})
    for seed in range(20):
        book.add(FI, seed, 20.0)
        book.add({"setting": "golden"}, seed, 20.0, injected=GOLDEN,
                 outcome="collision" if seed % 2 else "success")  # fmt: skip
    for seed in range(20, 40):
        book.plan(FI, seed)
        book.plan({"setting": "golden"}, seed)
    assert stopped(book.ledger) == ["setting=FI stage=control"]
