"""Which flights of a campaign are drawn together, and under which names."""

import pyarrow.parquet as pq
import pytest

from mavfi_cli.analysis.flights import exported
from mavfi_cli.analysis.trajectories import pair
from mavfi_cli.campaigns.begin import chosen, opened
from mavfi_cli.campaigns.missions import Injected
from mavfi_cli.campaigns.specification import Keep
from mavfi_cli.core.errors import ConfigError, RecordError
from mavfi_cli.spec.detector import DetectorConfig
from mavfi_cli.spec.fault import FaultConfig
from mavfi_cli.spec.mission import MissionConfig

GOLDEN = {"setting": "golden", "world": "dense"}


def fly(book, seed, times, *, kept=True, outcome="success", injected=Injected.ACTIVE):
    """A pair: golden, a fault of two stages, and the same protected; its first number."""
    first = book.ledger.planned()
    for place, (labels, time_s) in enumerate(zip(settings(), times, strict=True)):
        golden = labels == GOLDEN
        config = MissionConfig(
            seed=seed,
            fault=None if golden else FaultConfig(target=labels["stage"], seed=seed),
            detector=DetectorConfig(name="aad") if "detector" in labels else None,
        )
        book.add(
            labels, seed, time_s, injected=Injected.GOLDEN if golden else injected,
            outcome="success" if golden else outcome, config=config,
            path=f"runs/{first + place:06d}-dense-{seed}" if kept else None,
        )  # fmt: skip
    return first


def settings():
    faults = [{"setting": "FI", "world": "dense", "stage": s} for s in ("perception", "planning")]
    return [GOLDEN, *faults, *({**f, "setting": "D&R(A)", "detector": "aad"} for f in faults)]


def test_a_panel_for_each_fault_with_golden_faulty_and_protected(book):
    fly(book, 1, (20.0, 21.0, 25.0, 20.5, 20.0))
    fly(book, 2, (20.0,) * 5)
    drawn = pair(book.ledger, 3)
    assert drawn == pair(book.ledger, 0)
    assert [panel.title for panel in drawn.panels] == ["a bit of perception", "a bit of planning"]
    assert [[(each.number, each.name) for each in panel.flights] for panel in drawn.panels] == [
        [(0, "golden"), (1, "FI"), (3, "D&R(A)")],
        [(0, "golden"), (2, "FI"), (4, "D&R(A)")],
    ]
    faulty = drawn.panels[1].flights[1]
    assert (faulty.outcome, faulty.flight_time_s) == ("success", 25.0)
    assert faulty.path == book.ledger.folder.absolute() / "runs/000002-dense-1"
    assert drawn.absent == []


def test_an_export_has_the_picture_of_its_campaign(book, tmp_path):
    fly(book, 1, (20.0,) * 5)
    fly(book, 2, (20.0, 20.0, 24.0, 20.0, 20.0))
    path = tmp_path / "mine.parquet"
    pq.write_table(exported(book.ledger), path)
    with opened(path) as ledger:
        assert pair(ledger) == pair(book.ledger)
        assert pair(ledger, 1) == pair(book.ledger, 1) != pair(ledger)


def drawn_by_default(book):
    return pair(book.ledger).panels[0].flights[0].number


def test_without_a_number_the_pair_is_drawn_in_which_a_fault_costs_most_time(book):
    assert fly(book, 1, (20.0,) * 5) == 0
    assert drawn_by_default(book) == 0  # none costs time: the first
    fly(book, 2, (20.0, 20.0, 24.0, 20.0, 20.0))
    assert drawn_by_default(book) == 5
    fly(book, 3, (40.0, 40.0, 44.0, 40.0, 40.0))  # as much, of a longer flight
    fly(book, 4, (20.0, 20.0, 20.0, 50.0, 20.0))  # its detector costs time, not its fault
    fly(book, 5, (20.0, 90.0, 20.0, 20.0, 20.0), outcome="timeout")
    fly(book, 6, (20.0, 90.0, 20.0, 20.0, 20.0), injected=Injected.NOT_INJECTED)
    fly(book, 7, (20.0, 90.0, 20.0, 20.0, 20.0), kept=False)
    assert drawn_by_default(book) == 5
    fly(book, 8, (20.0, 25.0, 20.0, 20.0, 20.0))
    assert drawn_by_default(book) == 35


def test_what_is_not_in_the_picture_is_told(book):
    fly(book, 1, (20.0,) * 5)
    labels = {"setting": "FI", "world": "dense", "stage": "control"}
    for target, write in (("command_vx", book.fail), ("command_vy", book.plan)):
        number = write(labels, 1, MissionConfig(seed=1, fault=FaultConfig(target=target, seed=1)))
    drawn = pair(book.ledger, number)
    assert [text[:9] for text in drawn.absent] == ["mission 5", "mission 6"]
    assert drawn.absent[0].endswith(": blocked")
    assert len(drawn.panels) == 2


def test_a_flight_that_was_cut_off_is_told_and_the_others_are_drawn(book):
    fly(book, 1, (20.0,) * 5)
    runs = book.ledger.folder / "runs"
    for number in range(5):
        (runs / f"{number:06d}-dense-1").mkdir(parents=True)
        if number != 2:
            (runs / f"{number:06d}-dense-1" / "result.json").write_text("{}")
    drawn = pair(book.ledger)
    assert [each.number for each in drawn.panels[1].flights] == [0, 4]
    (absent,) = drawn.absent
    assert absent.startswith("mission 2: success, ")
    for left in runs.glob("*/result.json"):
        left.unlink()
    with pytest.raises(RecordError, match=r"missions 0, 1, 2, 3, 4, .*record"):
        pair(book.ledger)


def test_settings_of_one_name_are_told_apart(book):
    labels = {"setting": "D&R", "stage": "planning"}
    for name, protect in (("gad", "planning"), ("gad", "control"), ("aad", "control")):
        config = MissionConfig(seed=1, fault=FaultConfig(target="planning", seed=1),
                               detector=DetectorConfig(name=name, protect=(protect,)))  # fmt: skip
        book.add({**labels, "detector": name, "protect": protect}, 1, 20.0, config=config,
                 path="runs/some")  # fmt: skip
    (panel,) = pair(book.ledger).panels
    assert [each.name for each in panel.flights] == [
        "D&R, gad, planning", "D&R, gad, control", "D&R, aad, control",
    ]  # fmt: skip


def test_without_faults_there_is_one_panel(book):
    book.add({"world": "dense"}, 1, 20.0, injected=Injected.GOLDEN, path="runs/some")
    (panel,) = pair(book.ledger).panels
    assert (panel.title, [each.name for each in panel.flights]) == ("", ["golden"])


def test_a_pair_that_cannot_be_drawn_is_refused(book):
    with pytest.raises(RecordError, match="no pair"):
        pair(book.ledger)
    fly(book, 1, (20.0,) * 5, kept=False)
    with pytest.raises(RecordError, match="--keep all"):
        pair(book.ledger)
    with pytest.raises(RecordError, match="no run folder of missions 0, 1, 2, 3, 4"):
        pair(book.ledger, 2)
    with pytest.raises(ConfigError, match=r"mission 5 does not exist; .* 0 to 4"):
        pair(book.ledger, 5)
    book.plan(GOLDEN, 9)
    with pytest.raises(RecordError, match="the pair that contains mission 5"):
        pair(book.ledger, 5)


def test_fig13_keeps_what_is_drawn():
    spec, _ = chosen("fig13", None, 0.1)
    missions = spec.missions()
    assert spec.keep is Keep.ALL
    pairs = {}
    for mission in missions:
        stage = mission.labels.get("stage")
        pairs.setdefault(mission.pair, set()).add((mission.labels["setting"], stage))
    struck = {
        (setting, stage) for setting in ("FI", "D&R(A)") for stage in ("perception", "planning")
    }
    assert list(pairs.values()) == [{("golden", None), *struck}] * 2
