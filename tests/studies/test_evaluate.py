"""A whole evaluation: of hand-made pairs, and of a few real flights."""

import csv
import json
from dataclasses import asdict

import pyarrow as pa
import pytest
from made_flights import error_free, pair, pairs_table, struck
from missions import LAWN

from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.core.files import write_json
from mavfi_cli.report.detectors import (
    PICTURES,
    detector_csv,
    detector_lines,
)
from mavfi_cli.report.drawing import write_figure
from mavfi_cli.studies.evaluate import EvaluationPlan, evaluation_of

# The thresholds of the plan are not used: scores are given.
PLAN = EvaluationPlan(worlds=("dense", "farm"), detectors=("gad",), flights=2, golden_flights=2)
LOST = struck(None)


@pytest.fixture(scope="module")
def pairs():
    """One harmful fault in each world; the detector recovers that of dense only."""
    free, faults = [], []
    for world, saved in (("dense", True), ("farm", False)):
        for detector in ("none", "gad"):
            free += [error_free(world=world, seed=seed, detector=detector) for seed in (0, 1)]
        kept = struck(alarms_s=(20.1,)) if saved else LOST
        for faulty, protected, seed in ((LOST, kept, 0), (struck(), struck(), 1)):
            faults.append(pair(faulty, world=world, seed=seed))
            faults.append(pair(faulty, protected, world=world, seed=seed))
    return pairs_table(free), pairs_table(faults)


@pytest.fixture(scope="module")
def evaluation(pairs):
    harmful = {"stage": ["control"] * 2, "field": ["exponent"] * 2, "score": [2.0] * 2}
    return evaluation_of(
        PLAN, pairs, ["one could not"], lambda _: (pa.table(harmful), [0.5, 0.5, 0.5, 1.5])
    )


def row(rows, by, value, detector):
    (found,) = [row for row in rows if (row.by, row.value, row.detector) == (by, value, detector)]
    return found


def everything(rows, detector):
    """The row over all flights, of plain values."""
    (found,) = [row for row in rows if (row["by"], row["detector"]) == ("all", detector)]
    return found


def test_groups(evaluation):
    faults = evaluation.faults
    whole = row(faults, "all", "all", "gad")
    assert (whole.planned, whole.recovered.count) == (4, 1)
    assert row(faults, "world", "dense", "gad").recovered.share == 1.0
    assert row(faults, "world", "farm", "gad").recovered.share == 0.0
    assert row(faults, "state", "command_vx", "gad").harmful.count == 2
    assert row(faults, "field", "exponent", "none").detected_harmful.count == 0
    assert row(evaluation.error_free, "all", "all", "gad").flights == 4


def test_curves_and_their_parts(evaluation):
    found = evaluation.curves["gad"]
    assert (found.area, found.positives, found.negatives) == (1.0, 2, 4)
    assert found.operating_point == (0.25, 1.0)
    assert [(part["by"], part["value"]) for part in found.areas] == [
        ("stage", "control"), ("field", "exponent"),
    ]  # fmt: skip


def test_the_detector_is_compared_with_none(evaluation):
    (compared,) = evaluation.comparisons
    assert (compared.first, compared.second) == ("none", "gad")
    assert compared.recovered.only_second == 1


def test_the_table_fits_and_tells_the_numbers(evaluation):
    lines = detector_lines(evaluation)
    assert max(map(len, lines)) <= 100
    text = "\n".join(lines)
    assert "2 harmful: 2 lost the mission" in text
    assert "1/2: 50 % (9 to 91)" in text
    assert "1 missions could not be flown" in text


def test_files(evaluation, pairs, tmp_path):
    write_json(tmp_path / "evaluation.json", asdict(evaluation))
    read = json.loads((tmp_path / "evaluation.json").read_text())
    assert everything(read["faults"], "gad")["recovered"]["count"] == 1
    rows = list(csv.DictReader(detector_csv(*pairs).splitlines()))
    assert len(rows) == 16
    saved = [each for each in rows if each["harm"] == "lost" and each["remaining_harm"] == "none"]
    assert [(each["world"], each["detector"]) for each in saved] == [("dense", "gad")]
    assert float(saved[0]["latency_s"]) == pytest.approx(0.1)


def test_pictures_show_the_numbers(evaluation, tmp_path):
    figures = {name: draw(evaluation) for name, draw in PICTURES.items()}
    roc, precision = figures["roc.svg"].axes
    curve, dot = roc.lines[0], roc.lines[1]
    assert list(curve.get_xdata())[:2] == [0.0, 0.0]
    assert list(curve.get_ydata())[:2] == [0.0, 1.0]
    assert (dot.get_xdata()[0], dot.get_ydata()[0]) == (0.25, 1.0)
    assert (precision.lines[1].get_xdata()[0], precision.lines[1].get_ydata()[0]) == (1.0, 2 / 3)
    shares, times = figures["recovery.svg"].axes
    assert [bar.get_height() for bar in shares.patches[:2]] == [50.0, 50.0]  # all, control
    assert len(times.patches) == 4  # none and gad in two worlds
    for name, draw in PICTURES.items():
        write_figure(figures[name], tmp_path / name)
        first = (tmp_path / name).read_bytes()
        write_figure(draw(evaluation), tmp_path / name)
        assert (tmp_path / name).read_bytes() == first
        assert first.startswith(b"<?xml")


def test_an_evaluation_without_harm_has_no_curve():
    free = [error_free(detector=detector) for detector in ("none", "gad")]
    none = pa.table({"stage": [], "field": [], "score": []})
    empty = evaluation_of(PLAN, (pairs_table(free), pairs_table([])), [], lambda _: (none, [0.5]))
    assert "Faults" not in "\n".join(detector_lines(empty))
    assert not PICTURES["roc.svg"](empty).axes[0].lines[:-1]


@pytest.mark.slow
def test_real_flights_end_to_end(mavfi, tmp_path):
    """Two missions; called again nothing is flown, with more detectors the rest is."""
    world = tmp_path / "lawn.toml"
    world.write_text(LAWN)
    line = [
        "detect", "evaluate", "--world", world, "--flights", 1, "--golden-flights", 2,
        "--field", "exponent,integer", "--out", tmp_path / "out", "--quiet", "--json",
    ]  # fmt: skip
    first = mavfi(*line, "--detector", "range")
    assert first.returncode == 0, first.stderr
    found = json.loads(first.stdout)
    faults = everything(found["faults"], "range")
    parts = ("active", "golden_failed", "not_activated", "not_injected")
    assert faults["planned"] == sum(faults[part] for part in parts) == 5
    assert everything(found["error_free"], "range")["flights"] == 2
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "bare", "evaluation.csv", "evaluation.json", "protected", "recovery.svg", "roc.svg",
        "scores.json",
    ]  # fmt: skip
    (folder,) = (tmp_path / "out" / "protected").iterdir()
    assert folder.name.startswith("range-")
    with Ledger(folder) as ledger:
        before = ledger.over()
    assert before == 2 + 5
    again = mavfi(*line, "--detector", "none,range")
    assert again.stdout == first.stdout
    text = mavfi(*line[:-1], "--detector", "none,range").stdout
    files = "evaluation.json, evaluation.csv, roc.svg, recovery.svg"
    assert text.splitlines()[-1] == f"Files  {tmp_path / 'out'}: {files}"
    with Ledger(folder) as ledger:
        assert ledger.over() == before
