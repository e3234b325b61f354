"""A run in words, for every way in which it can end."""

import json
import re

import pytest

from mavfi_cli.core.types import Outcome
from mavfi_cli.mission.measures import FlightRecord
from mavfi_cli.report.summary import event_lines, outcome_line, summary_lines


@pytest.fixture
def result(short_flight):
    return json.loads(short_flight.result.read_text())


@pytest.mark.parametrize("outcome", Outcome)
def test_every_outcome_has_its_words(result, outcome):
    result.update(outcome=outcome.value, reason="why it was")
    first = summary_lines(FlightRecord.of(result))[0]
    assert first.startswith(outcome.value.upper().replace("_", " "))
    assert first.endswith("(why it was)")
    result["reason"] = ""
    assert "(" not in outcome_line(FlightRecord.of(result))


def test_the_figures_are_those_of_the_record(result):
    text = "\n".join(summary_lines(FlightRecord.of(result)))
    quality = result["quality_of_flight"]
    for figure in (
        f"{quality['flight_time_s']:.1f} s from take-over, ",
        f"{quality['distance_m']:.1f} m flown",
        f"{quality['goal_distance_m']:.2f} m from the goal",
        f"{quality['min_clearance_m']:.2f} m minimum",
        f"{quality['energy_regression_j'] / 1e3:.1f} kJ (paper's regression)",
        f"{quality['energy_propeller_j'] / 1e3:.1f} kJ (propeller shafts)",
        f"{result['pilot']['plans_requested']} requested",
        f"{result['response_time_s']['median'] * 1e3:.0f} ms from depth frame",
        f"{result['simulated_s'] / result['host']['flight_wall_s']:.0f} times real time",
        "solo in farm, seed 5; planner rrtstar, platform x86, stack hardened",
    ):
        assert figure in text


def test_a_mission_that_ended_before_its_flight_says_so(result):
    result["quality_of_flight"] = dict.fromkeys(result["quality_of_flight"])
    lines = summary_lines(FlightRecord.of(result | {"outcome": "interrupted"}))
    assert any(line.startswith("Flight      none: ") for line in lines)
    assert "not known" not in "\n".join(lines)


def test_the_plans_add_up(result, troubled_flight):
    for run in (result, json.loads(troubled_flight.result.read_text())):
        text = "\n".join(summary_lines(FlightRecord.of(run)))
        found = re.search(
            r"(\d+) requested: (\d+) flown(?: \((\d+) replans\))?, (\d+) failed.*, (\d+) not used",
            text,
        )
        asked, flown, replans, failed, unused = (int(each or 0) for each in found.groups())
        assert asked == flown + failed + unused == run["pilot"]["plans_requested"]
        assert flown == replans + 1
        assert failed == run["pilot"]["plans_failed"]
        assert unused >= run["pilot"]["plans_ignored"] + run["pilot"]["plans_rejected"]


def test_what_is_not_known_is_said_so(result):
    quality = dict.fromkeys(result["quality_of_flight"])
    result["quality_of_flight"] = quality | {"flight_time_s": 12.0, "distance_m": 30.0}
    result["response_time_s"] = {"median": None, "p95": None, "count": 0}
    result["host"]["flight_wall_s"] = 0.0
    text = "\n".join(summary_lines(FlightRecord.of(result)))
    assert "Flight      12.0 s from take-over, 30.0 m flown, not known" in text
    assert "Clearance   not known\n" in text
    assert "Energy      not known\n" in text
    assert "None" not in text
    assert "nan" not in text
    assert "Response" not in text
    assert "Host" not in text


def test_a_foreign_autopilot_is_named_by_its_link(result):
    result["config"]["link"] = "udpin:127.0.0.1:14540"
    assert "foreign autopilot at udpin:127.0.0.1:14540" in "\n".join(
        summary_lines(FlightRecord.of(result))
    )


def test_a_long_line_goes_on_below_its_text(result):
    states = [f"waypoint_a{axis}" for axis in "xyz"]
    change = {"state": states[0], "index": 7, "bits": [52, 60], "before": 0.5, "after": 1.78e231,
              "before_hex": "0x3fe0000000000000", "after_hex": "0x7ff0000000000001"}  # fmt: skip
    result["fault"] = {
        "level": "source", "stage": "planning", "states": states, "state": "applied",
        "request": {"persistence": "transient", "effect": "flip"},
        "trigger": {"when": "phase", "phase": "flying", "number": 0, "drawn_time_s": 0.0},
        "strikes": [{"stamp_s": 10.52, "changes": [change]}], "strike_count": 1, "reason": "",
        "activation": {"first_reader": None, "activation": "overwritten"},
    }  # fmt: skip
    lines = summary_lines(FlightRecord.of(result))
    assert max(map(len, lines)) <= 100
    place = next(place for place, line in enumerate(lines) if line.startswith("Fault"))
    assert ": transient flip" in lines[place]
    assert re.fullmatch(" {12}.*flying", lines[place + 1])
    assert lines[place + 2].endswith("waypoint_ax[7] 0.5 -> 1.78e+231 (bits 52, 60)")


def test_a_struck_instruction_is_in_a_function_with_a_plain_name(result):
    result["fault"] = {
        "level": "instruction", "node": "octomap", "kernel": "octomap", "invocation": 15,
        "invocations": 78, "stamp_s": 13.39, "sampling": "instruction-uniform", "k": 3,
        "windows": "16 of 7704", "instruction": "and ebx, 1", "state": "null", "offset": 0x1234,
        "symbol": "_ZNK7octomap14OcTreeBaseImplINS_10OcTreeNodeEE6searchERKNS_9OcTreeKeyEj+0x205",
        "object": "liboctomap.so",
    }  # fmt: skip
    told = "before execution 3 of and ebx, 1 ({})"
    assert told.format("search+0x205 in liboctomap.so") in "\n".join(
        summary_lines(FlightRecord.of(result))
    )
    result["fault"]["symbol"] = ""
    assert told.format("liboctomap.so+0x1234") in "\n".join(summary_lines(FlightRecord.of(result)))


@pytest.mark.parametrize(("bits", "told"), [([3], "bit 3 of"), ([3, 40], "bits 3, 40 of")])
def test_the_bits_of_a_struck_instruction_are_counted(result, bits, told):
    result["fault"] = {
        "level": "instruction", "node": "octomap", "kernel": "octomap", "invocation": 1,
        "invocations": 2, "stamp_s": 1.0, "sampling": "instruction-uniform", "k": 3, "windows": "",
        "instruction": "and ebx, 1", "state": "applied", "offset": 1, "symbol": "", "object": "a",
        "corruption": {"bits": bits, "role": "destination", "register": "rbx", "site": "register"},
        "injection": {"before": "0x1", "after": "0x9"}, "activation": {"activation": "not_read"},
    }  # fmt: skip
    line = f"            {told} destination rbx: 0x1 -> 0x9; not read"
    assert line in summary_lines(FlightRecord.of(result))


def test_events_come_one_a_line_in_order(result):
    lines = event_lines(FlightRecord.of(result))
    assert len(lines) == len(result["events"])
    assert lines[-1].split() == [f"{result['simulated_s']:.2f}", "s", "outcome", "success"]
