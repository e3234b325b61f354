"""Table V of a campaign: what is averaged over which missions, and what the table calls it."""

import json
import math
import re

import pytest
from click.testing import CliRunner
from made_flights import watched

from mavfi_cli.analysis.overhead import flight_overheads
from mavfi_cli.analysis.summary import groups
from mavfi_cli.campaigns.missions import Injected
from mavfi_cli.cli.campaign import campaign as command
from mavfi_cli.mission.measures import HOST_CHECKS
from mavfi_cli.report.campaign import overhead_lines

GAD = {"setting": "D&R(G)", "world": "dense", "detector": "gad"}
AAD = {"setting": "D&R(A)", "world": "dense", "detector": "aad"}


def again(*stages):
    """Alarms after which these stages are recomputed."""
    return [(stage, "recompute") for stage in stages]


@pytest.fixture
def filled(book):
    """Flights of 20 s (40 s: the third); gad recomputes perception and planning, aad control."""
    for seed, time_s in enumerate((20.0, 20.0, 40.0)):
        book.add({"setting": "golden", "world": "dense"}, seed, 20.0, injected=Injected.GOLDEN)
        book.add({"setting": "FI", "world": "dense"}, seed, time_s)
        alarms = again(*[(), ("perception",), ("perception", "planning")][seed])
        book.add(GAD, seed, time_s, record=watched("gad", 0.004 * (1 + seed), alarms))
        alarms = again(*[(), (), ("control",)][seed])
        book.add(AAD, seed, time_s, record=watched("aad", 0.006, alarms))
    book.add(GAD, 7, 20.0, injected=Injected.NOT_INJECTED, record=watched("gad", 9.0))
    return book


def test_every_setting_with_a_detector_has_its_shares_of_the_flight_time(filled):
    gad, aad = flight_overheads(filled.ledger, groups(filled.ledger))
    assert (gad.labels, aad.labels) == (GAD, AAD)
    assert (gad.flights, aad.flights) == (3, 3)  # not the one whose fault was not injected
    assert gad.checks_per_s.value == pytest.approx((50.0 + 50.0 + 25.0) / 3)
    assert gad.check_host_s.value == pytest.approx(8e-6)
    shares = [0.004 / 20, 0.008 / 20, 0.012 / 40]
    assert gad.detection_host_share.value == pytest.approx(sum(shares) / 3)
    assert min(shares) <= gad.detection_host_share.low < gad.detection_host_share.high
    assert gad.recomputations == {"perception": 2.0, "planning": 1.0, "control": 0.0}
    perception = (0.36 / 20 + 0.36 / 40) / 3
    assert gad.recovery_share["perception"].value == pytest.approx(perception)
    assert gad.recovery_share["planning"].value == pytest.approx(0.2 / 40 / 3)
    assert gad.recovery_share["control"].value == 0.0
    again = gad.recovery_share_in_all
    assert again.value == pytest.approx(perception + 0.2 / 40 / 3)
    assert 0.0 <= again.low < again.value < again.high <= 0.36 / 20
    assert gad.share_in_all.value == pytest.approx(again.value + gad.detection_host_share.value)
    assert aad.recovery_share_in_all.value == pytest.approx(0.0005 / 40 / 3)


def test_a_setting_that_gathers_several_detectors_has_a_row_for_each(filled):
    rows = flight_overheads(filled.ledger, groups(filled.ledger, ["world"]))
    assert [each.labels for each in rows] == [
        {"world": "dense", "detector": "aad"}, {"world": "dense", "detector": "gad"},
    ]  # fmt: skip


def test_the_detector_need_not_be_a_label(book):
    book.add({"setting": "golden"}, 1, 20.0, injected=Injected.GOLDEN, record=watched("l2", 0.01))
    (row,) = flight_overheads(book.ledger, groups(book.ledger))
    assert row.labels == {"setting": "golden", "detector": "l2"}
    assert math.isnan(row.check_host_s.low)  # one flight has no interval
    assert re.split("  +", overhead_lines([row])[3])[-2:] == ["10.00", "0.0500"]


def test_the_tables_say_what_the_host_measured_and_what_was_simulated(filled):
    found = flight_overheads(filled.ledger, groups(filled.ledger))
    told = overhead_lines(found, 0.9)
    assert "host time" in told[1]
    assert told[2].endswith(": world=dense")
    assert "90 % interval" in told[3]
    assert told[6] == f"({HOST_CHECKS})"
    assert "simulated" in told[8]
    first, second, third = (row.split()[2:] for row in told if row.startswith("D&R(G)"))
    assert first[:3] == ["3", "41.7", "8.00"]
    assert first[6] == "0.0300"
    assert second[:5] == ["3", "0.9000", "0.1667", "0.0000", "1.0667"]
    assert third[0] == "1.0967"  # 0.0300 of checks, and 1.0667 of recovery
    rare = overheads_of_one_in(100, filled)
    assert " <0.0001 " in rare


def overheads_of_one_in(count, book):
    """The rows of many flights of which one recomputes control, in a hundredth of the time."""
    labels = {"setting": "rare", "world": "dense", "detector": "aad"}
    kernels = {"control": {"invocations": 1000, "busy_s": 0.1}}
    for seed in range(count):
        record = watched("aad", 0.004, again("control") if seed == 0 else ()) | {"kernels": kernels}
        book.add(labels, 100 + seed, 200.0, record=record)
    found = flight_overheads(book.ledger, groups(book.ledger))
    return "\n".join(line for line in overhead_lines(found) if line.startswith("rare "))


def test_a_campaign_without_detectors_says_so(book):
    book.add({"setting": "golden"}, 1, 20.0, injected=Injected.GOLDEN)
    found = flight_overheads(book.ledger, groups(book.ledger))
    assert (found, len(overhead_lines(found))) == ([], 2)


def test_the_command_shows_it_where_it_is_asked_for(filled):
    folder = str(filled.ledger.folder)
    plain = CliRunner().invoke(command, ["status", folder, "--full"])
    asked = CliRunner().invoke(command, ["status", folder, "--overhead"])
    assert "host time" not in plain.output
    assert asked.output.startswith(plain.output)
    assert "host time" in asked.output
    told = CliRunner().invoke(
        command, ["status", folder, "--overhead", "--by", "setting", "--json"]
    )
    gad, aad = json.loads(told.output)["overhead"]
    assert gad["labels"] == {"setting": "D&R(G)", "detector": "gad"}
    assert gad["recovery_share"]["perception"]["count"] == 3
    assert aad["detection_host_share"]["value"] == pytest.approx((0.0003 * 2 + 0.00015) / 3)


def test_table_v_has_the_flights_that_it_needs():
    """Both detectors, every stage, each world; and faults whose recovery has to be paid."""
    from mavfi_cli.campaigns.begin import chosen

    spec, _ = chosen("table4", None, 0.01)
    flown = {
        (mission.config.detector.name, mission.labels["stage"], mission.config.world)
        for mission in spec.missions()
        if mission.config.detector is not None
    }
    worlds = ("factory", "farm", "sparse", "dense")
    assert flown == {
        (name, stage, world)
        for name in ("gad", "aad")
        for stage in ("perception", "planning", "control")
        for world in worlds
    }
