"""The tables that benchmarks print of the shipped exports, against counts made without them."""

import itertools
import subprocess
import sys
from pathlib import Path

import pyarrow.parquet as pq
import pytest

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "docs" / "results"
REPLICA_TABLE4 = [RESULTS / f"replica-table4-part{part}.parquet" for part in (1, 2)]


def table(name, *arguments):
    """The rows that a benchmark prints, each as a list of cells."""
    done = subprocess.run(
        [sys.executable, f"benchmarks/{name}.py", *map(str, arguments)],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    lines = (line for line in done.stdout.splitlines() if line.startswith("| "))
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def missions(path):
    return pq.read_table(RESULTS / path).to_pylist()


def test_exceptions_of_wrappers_are_counted_apart_from_other_dead_nodes():
    printed = table(
        "silent_and_dead", *REPLICA_TABLE4,
        *("--by", "detector", "label_node_restart_s", "label_stage"),
    )  # fmt: skip
    assert printed[0][-1] == "lost, exception"
    own = {(delay, stage): row[-1] for watch, delay, stage, *row in printed if not watch}
    assert own["1.0", "planning"].startswith("3 of 3,")
    assert own["1.0", "control"].startswith("0 of 27,")
    assert own["3600.0", "planning"].startswith("3 of 3,")
    assert own["3600.0", "control"].startswith("22 of 27,")
    assert own["3600.0", "perception"] == "0 of 0"


@pytest.mark.slow
def test_only_flights_that_replan_lose_a_planner():
    rows = missions("paper-mavbench.parquet")
    golden = {
        (row["world"], row["seed"]): row
        for row in rows
        if (row["injected"], row["detector"]) == ("golden", None)
        and (row["planner"], row["platform"]) == ("rrtstar", "x86")
    }
    counts = {}
    for row in rows:
        if (row["level"], row["detector"], row["planner"]) == ("instruction", None, "rrtstar"):
            own = golden[row["world"], row["seed"]]
            if own["outcome"] == "success":
                name = str(own["replans"]) if own["replans"] < 4 else "4 or more"
                flown, lost = counts.get(name, (0, 0))
                counts[name] = flown + 1, lost + (row["outcome"] != "success")
    assert counts == {
        "0": (1034, 0), "1": (200, 9), "2": (114, 11), "3": (87, 11), "4 or more": (162, 20),
    }  # fmt: skip
    by = ("--by", "detector", "planner", "golden_replans")
    file = RESULTS / "paper-mavbench.parquet"
    for place, (watch, planner, name, every, *_) in enumerate(table("silent_and_dead", file, *by)):
        if place and not watch and planner == "rrtstar":
            flown, lost = counts.pop(name)
            assert every.startswith(f"{lost} of {flown},")
    assert counts == {}
    printed = table("lost_missions", file, "--by", "level", *by[1:])
    ends = {row[3]: row[4] for row in printed if row[:3] == ["instruction", "", "rrtstar"]}
    assert ends["0"].startswith("0 of 924,")  # only faults that were read
    assert ends["golden lost"].startswith("3 of 3,")


@pytest.mark.parametrize(
    ("parts", "expected"),
    [
        (["replica-kills"], {("all", "supervisor"): ("5, 0", "0.0625", "5, 0", "0.0625")}),
        (
            ["replica-kills", "replica-kills-part2"],  # whose arms differ
            {
                ("all", "supervisor"): ("10, 0", "0.00195", "10, 0", "0.00195"),
                ("all", "a process for each node"): ("3, 0", "0.25", "3, 0", "0.25"),
            },
        ),
        (
            ["replica-planning-part1"],
            {
                ("dense", "hot standby"): ("6, 0", "0.0312", "13, 0", "0.000244"),
                ("factory", "hot standby"): ("13, 0", "0.000244", "26, 0", "2.98e-08"),
                ("factory", "AAD"): ("0, 0", "1", "0, 0", "1"),
            },
        ),
        (["replica-arms-part1"], {("dense", "supervisor"): ("2, 0", "0.5", "2, 0", "0.5")}),
    ],
)
def test_protections_are_compared_by_world_and_pooled(parts, expected):
    printed = table("protections_rule", *(RESULTS / f"{part}.parquet" for part in parts))
    rows = {(row[0], row[1]): row[3:] for row in printed if row[2:3] == ["no protection"]}
    compared = {names: (*rows[names][:2], *rows[names][3:5]) for names in expected}
    assert compared == expected
    if "replica-planning-part1" in parts:  # its rule: Holm for five arms in two worlds
        assert rows["factory", "supervisor"][-1] == "2.98e-07"


@pytest.mark.slow
def test_the_factorial_prints_each_of_its_cells():
    names = ("factorial-many.parquet", "factorial-fixed.parquet")
    files = [RESULTS / name for name in names]
    printed = table("factorial", "--many", files[0], "--fixed", files[1])[-33:]
    assert printed[0][-3:] == ["% (bootstrap)", "% (Wilson)", "minus the paper's, points"]
    assert len({tuple(row[:5]) for row in printed[1:]}) == 32
    ours = "ours", "ours", "never back", "any bit of any operand"
    assert ["one for each seed", *ours, "41 of 108"] in [row[:6] for row in printed]
    for *_, lost, _, percent, beyond in printed[1:]:
        count, _, total = lost.partition(" of ")
        share = 100.0 * int(count) / int(total)
        assert float(percent.split()[0]) == pytest.approx(share, abs=0.06)
        # The paper's Table IV: 380 of 400 golden flights and 1058 of 1200 with faults succeed.
        assert float(beyond.split()[0]) == pytest.approx(share - 95.0 + 1058 / 12, abs=0.06)
    lost = sum(int(row[5].split()[0]) for row in printed[1:])
    golden = {
        (name, row["world"], row["seed"], row["stack"]): row["outcome"] == "success"
        for name in names
        for row in missions(name)
        if row["injected"] == "golden"
    }
    struck = itertools.chain.from_iterable(
        [(name, row) for row in missions(name) if row["injected"] != "golden"] for name in names
    )
    assert lost == sum(
        row["outcome"] != "success" and golden[name, row["world"], row["seed"], row["stack"]]
        for name, row in struck
    )
