"""Reproductions without flights: forecast, resumption after a kill, growth, and bad folders."""

import multiprocessing
import os
import shutil
import signal
from collections import namedtuple
from dataclasses import replace

import pyarrow.parquet as pq
import pytest
from made_flights import Book, export_table, row

from mavfi_cli.analysis.pairs import Fate
from mavfi_cli.campaigns.ledger import ExportedLedger, Ledger
from mavfi_cli.campaigns.progress import Spectator
from mavfi_cli.campaigns.run import PROFILES, Options, store_plan
from mavfi_cli.core.errors import ConfigError, RecordError
from mavfi_cli.paper import flying
from mavfi_cli.paper.claims import judged
from mavfi_cli.paper.items import FlightsPlan, items_named
from mavfi_cli.paper.settling import settle
from mavfi_cli.paper.sources import Evidence
from mavfi_cli.paper.status import shown, tables

pytestmark = pytest.mark.usefixtures("no_vehicle")
TASK = Options(jobs=2, task="fake_task")
SCALE = 0.02  # two of each hundred


def plan(out, *names, scale=SCALE, stack="mavbench"):
    return FlightsPlan(items=items_named(names), stack=stack, scale=scale, out=out)


def flown(asked, options=TASK, spectator=None):
    """Reproduce; the forecast."""
    told = []
    flying.reproduce(asked, options, spectator or Spectator(), told.append)
    (forecast,) = told
    return forecast


@pytest.fixture(scope="module")
def fig9(no_vehicle, tmp_path_factory):
    """A reproduction of Fig. 9 and its forecast; copy the folder before you change it."""
    asked = plan(tmp_path_factory.mktemp("fig9"), "fig9")
    return asked, flown(asked)


@pytest.fixture
def copied(fig9, tmp_path):
    """The same reproduction in a folder that may change."""
    asked, _ = fig9
    shutil.copytree(asked.folder, tmp_path / asked.folder.name)
    return plan(tmp_path, "fig9")


def over(asked):
    with Ledger(asked.folder) as ledger:
        return ledger.over()


@pytest.mark.slow
def test_only_the_missions_of_the_named_items_are_flown(fig9, copied, tmp_path):
    (_, forecast), asked = fig9, copied
    assert forecast.missions == len(asked.missions()) == 8
    with Ledger(asked.folder) as ledger:
        assert (ledger.over(), ledger.planned()) == (8, 356)
        assert FlightsPlan.stored(ledger).scale == SCALE
        table, flights = shown(ledger, "fig9")
        assert (table.rows[0].cells[0].count, len(flights)) == (2, 8)
        assert shown(ledger, "fig15")[1] is None
        assert len(shown(ledger, "table3")[1]) == 2  # the golden ones, shared
    more = flown(plan(tmp_path, "table3"))
    assert (more.missions, more.over) == (8, 2)
    assert over(asked) == 14


@pytest.mark.slow
def test_the_forecast_comes_from_missions_that_count(tmp_path):
    asked = plan(tmp_path, "fig16")
    notes = []
    watched = Spectator()
    watched.on_note = notes.append
    forecast = flown(asked, spectator=watched)
    assert notes == ["measuring 13 missions"]
    assert (forecast.missions, forecast.over, forecast.measured) == (40, 13, 13)
    assert forecast.seconds > 0.0
    assert forecast.disk_bytes > 0.0
    assert over(asked) == 40


def test_a_forecast_takes_the_rate_of_each_kind():
    measured = [("golden", 10.0)] * 20 + [("source", 2.0), ("source", 4.0), ("instruction", 1.0)]
    missing = {"golden": 1, "source": 100, "instruction": 1000}
    assert flying.remaining_s(measured, missing) == 10.0 + 300.0 + 1000.0
    assert flying.remaining_s([("golden", 4.0), ("source", 2.0)], {"instruction": 10}) == 30.0
    assert flying.remaining_s([], {"golden": 3}) == 0.0


@pytest.mark.slow
def test_each_kind_that_is_missing_is_measured(tmp_path):
    asked = plan(tmp_path, "fig9", "table4", scale=0.05)
    forecast = flown(asked)
    with Ledger(asked.folder) as ledger:
        kinds = {kind for kind, _ in flying._kinds(ledger.results())}
    assert {"golden", "source"} <= kinds
    assert forecast.measured >= 4 * len(kinds)


def test_a_forecast_counts_the_profiles_of_two_repetitions(tmp_path):
    asked = plan(tmp_path, "table4", scale=0.05)
    with Ledger(tmp_path / "table4", writing=True) as ledger:
        store_plan(ledger, asked.missions())
        every = frozenset(range(ledger.planned()))
        goldens = {
            mission.config.golden
            for mission in asked.missions()
            if mission.config.instruction and mission.config.seed in (1, 2)
        }
        assert goldens
        before = flying._with_flights(flying.Forecast(), ledger, every, Options(), [])
        assert before.disk_bytes > len(goldens) * flying._PROFILES_BYTES
        for golden in range(2):
            (ledger.folder / PROFILES / str(golden)).mkdir(parents=True)
            (ledger.folder / PROFILES / str(golden) / "orders.npz").write_bytes(bytes(300))
        after = flying._with_flights(flying.Forecast(), ledger, every, Options(), [])
    assert before.disk_bytes - after.disk_bytes == len(goldens) * (flying._PROFILES_BYTES - 300)


def test_few_missions_are_not_measured(fig9):
    _, first = fig9
    assert (first.missions, first.measured, first.seconds) == (8, 0, 0.0)
    assert first.disk_bytes > 0.0


@pytest.mark.slow
def test_run_folders_are_kept_for_the_pictures(tmp_path):
    asked = plan(tmp_path, "fig11", "fig13", "fig9")
    flown(asked)
    with Ledger(asked.folder) as ledger:
        kept = [each.number for each in ledger.results() if each.path is not None]
        drawn = [shown(ledger, name)[1]["number"] for name in ("fig11", "fig13")]
        assert kept == sorted({*drawn[0], *drawn[1]}) == asked.kept(ledger)
    assert all(drawn)


class _Killer(Spectator):
    """Kills its own process, as kill -9 does, once some missions are over."""

    def on_progress(self, progress):
        if progress.over >= 20:
            os.kill(os.getpid(), signal.SIGKILL)


def _die(asked):
    flown(asked, spectator=_Killer())


@pytest.mark.slow
def test_a_killed_reproduction_resumes(tmp_path):
    asked = plan(tmp_path, "fig16")
    child = multiprocessing.get_context("fork").Process(target=_die, args=(asked,))
    child.start()
    child.join(60)
    assert child.exitcode == -signal.SIGKILL
    done = over(asked)
    assert 20 <= done < 40
    forecast = flown(asked)
    assert (forecast.over, over(asked)) == (done, 40)
    whole = plan(tmp_path / "whole", "fig16")
    flown(whole)
    with Ledger(asked.folder) as first, Ledger(whole.folder) as second:
        results = [[each.result for each in ledger.results()] for ledger in (first, second)]
    assert results[0] == results[1]


@pytest.mark.slow
def test_a_folder_grows_to_a_larger_scale_and_never_shrinks(copied, tmp_path):
    forecast = flown(plan(tmp_path, "fig9", scale=0.03))
    assert (forecast.missions, forecast.over) == (12, 8)
    with pytest.raises(ConfigError, match="cannot shrink to 0"):
        flown(copied)


def test_each_stack_has_its_own_folder(copied, tmp_path):
    other = plan(tmp_path, "fig9", stack="mavbench:guards_tracking=true")
    assert other.folder == tmp_path / "mavbench-guards_tracking=true"
    copied.folder.rename(other.folder)
    with pytest.raises(ConfigError, match="stack mavbench, not mavbench:guards_tracking=true"):
        flown(other)


@pytest.mark.slow
def test_a_rule_is_kept_reported_and_settled(tmp_path):
    never = replace(plan(tmp_path, "table4"), node_restart_s=3600.0)
    assert flown(never).missions == len(never.missions()) == 4 * 2 * (1 + 3 * 3)
    with Ledger(never.folder) as ledger:
        stored = FlightsPlan.stored(ledger)
        assert (stored.rule, stored.items) == ("dead nodes never back", never.every)
        assert len(shown(ledger, "table4")[1]) == len(never.missions())
    with pytest.raises(ConfigError, match="under dead nodes never back, not the usual restart"):
        flown(plan(tmp_path, "table4"))
    (table,) = tables(never)
    assert [line.count for line in table.rows[:2]] == ["2", "6"]
    with flying.opened(never) as ledger:
        settle(never, ledger, TASK, Spectator(), 1e-9)  # too short a time: it flies nothing
    evidence = Evidence.gather([tmp_path])
    regime = "mavbench, dead nodes never back"
    assert evidence.settled.keys() == {regime, "mavbench, fixed worlds, dead nodes never back"}
    claims = judged(evidence.by_place(["mavbench"]), {}, evidence.settled)
    (line,) = {entry.judgements[regime][Fate.ALL].history for entry in claims
               if entry.claim.item == "table4" and not entry.claim.golden}  # fmt: skip
    assert line


def test_another_campaign_is_refused(tmp_path):
    book = Book(tmp_path / "mavbench")
    book.plan({}, 1)
    book.ledger.close()
    with pytest.raises(ConfigError, match="not a reproduction"):
        flown(plan(tmp_path, "fig9"))


@pytest.mark.parametrize("text", ["[]", "{", '{"stack": "mavbench", "of_tomorrow": 1}'])
def test_a_plan_that_cannot_be_read_is_refused(copied, text):
    with Ledger(copied.folder, writing=True) as ledger:
        ledger.set_meta({"reproduction": text})
    with pytest.raises(ConfigError, match="plan of another version of mavfi, or a damaged one"):
        flown(copied)


def test_other_versions_are_refused(copied, tmp_path):
    with Ledger(copied.folder, writing=True) as ledger:
        ledger.set_meta({"versions": '{"mavfi":"0.1"}'})
    with pytest.raises(ConfigError, match="versions have changed since it began"):
        flown(plan(tmp_path, "fig9", scale=0.03))
    with Ledger(copied.folder) as ledger:
        assert FlightsPlan.stored(ledger).scale == SCALE  # nothing was changed


def test_a_full_disk_is_told_before_the_flights(tmp_path, monkeypatch):
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(flying.shutil, "disk_usage", lambda place: usage(1000, 1000, 0))
    with pytest.raises(RecordError, match="GB is free"):
        flown(plan(tmp_path, "fig16"))
    assert over(plan(tmp_path)) == 13  # which the forecast is from


def exported(tmp_path, rows):
    """The ledger of an export with these rows, which has no plan."""
    path = tmp_path / "some.parquet"
    pq.write_table(export_table(rows), path)
    return ExportedLedger(path)


def in_dense(*arguments, **changes):
    return row(*arguments, config={"world": "dense"}, **changes)


def test_an_export_has_the_items_whose_flights_it_holds(tmp_path):
    rows = [in_dense(), in_dense("planning", instruction=True)]
    with exported(tmp_path, rows) as ledger:
        table, flights = shown(ledger, "table4")
        assert len(flights) == 2
        assert [line.count for line in table.rows] == ["1", "1", "0", "0"]
        with pytest.raises(RecordError, match=r"no flights .*Table III"):
            shown(ledger, "table3")


def test_an_export_without_pairs_has_a_note_and_no_effect(tmp_path):
    rows = [in_dense("planning", instruction=True, seed=seed) for seed in (1, 2)]
    with exported(tmp_path, rows) as ledger:
        table, _ = shown(ledger, "fig12")
    assert table.notes[-2].startswith("2 of 2 flights")
    assert {line.count for line in table.rows} == {"0"}


def test_golden_flights_alone_are_no_item_with_faults(tmp_path):
    with (
        exported(tmp_path, [in_dense()]) as ledger,
        pytest.raises(RecordError, match=r"no flights .*Fig\. 14"),
    ):
        shown(ledger, "fig14")


def test_an_item_of_two_stacks_is_refused(tmp_path):
    stacks = [{"world": "dense", "stack": stack} for stack in ("mavbench", "hardened")]
    rows = [row("planning", instruction=True, config=config) for config in stacks]
    with (
        exported(tmp_path, rows) as ledger,
        pytest.raises(RecordError, match=r"Table IV .*stacks"),
    ):
        shown(ledger, "table4")


def test_an_item_is_shown_under_one_rule_which_its_notes_name(tmp_path):
    never = {"world": "dense", "node_restart_s": 3600.0}
    late = [
        row("planning", instruction=True, seed=seed, config=never, outcome="timeout")
        for seed in (1, 2)
    ]
    with exported(tmp_path, [in_dense(), *late]) as ledger:
        table, flights = shown(ledger, "table4")
    assert "rule of the faults in instructions: dead nodes never back" in table.notes
    assert flights["level"].count("instruction") == 2
    usual = in_dense("planning", instruction=True)
    with exported(tmp_path, [in_dense(), row(config=never), usual, *late]) as ledger:
        table, flights = shown(ledger, "table4")
    assert "not in this table: dead nodes never back" in table.notes
    assert not any(note.startswith("rule") for note in table.notes)
    assert flights["level"] == [None, "instruction"]  # the golden flight counts once
