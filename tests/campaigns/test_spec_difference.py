"""In what words two specifications differ."""

from pathlib import Path

import pytest

from mavfi_cli.campaigns.specification_file import parse_spec
from mavfi_cli.studies.compare import ComparePlan

STORED = """
repetitions = 10
[mission]
time_limit_s = 100.0
[factors]
world = ["farm", "dense"]
[[setting]]
name = "FI"
stage = ["control", "planning"]
bits = [1, 3]
[[setting]]
name = "D&R"
bits = [1]
"""


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('"farm", "dense"', '"sparse"', ["world farm, dense there, sparse here"]),
        ('"farm", "dense"', '"dense", "sparse"', ["world farm, dense there, dense, sparse here"]),
        ('"farm", "dense"', '"farm"', ["world farm, dense there, farm here"]),
        ('stage = ["control", "planning"]', "", ["stage control, planning there, none here"]),
        ("repetitions = 10", "repetitions = 5", ["repetitions 10 there, 5 here"]),
        ("repetitions = 10", "repetitions = 10\nseed = 2", ["fault seed 1 there, 2 here"]),
        ("= 100.0", "= 90.0", ["mission.time_limit_s 100.0 there, 90.0 here"]),
        ('"FI"', '"faults"', ["settings FI, D&R there, faults, D&R here"]),
        ("bits = [1]", "bits = [3]", ["bits of setting D&R 1 there, 3 here"]),
        ('name = "FI"', 'name = "FI"\nrepetitions = 4',
         ["repetitions of setting FI none there, 4 here"]),
        ("repetitions = 10", 'repetitions = 10\nname = "other"\nkeep = "all"', []),
    ],
)  # fmt: skip
def test_what_differs_is_said_in_words(old, new, told):
    assert STORED.count(old) == 1
    stored, asked = (
        parse_spec(text, Path("x.toml")) for text in (STORED, STORED.replace(old, new))
    )
    assert stored.differences(asked) == told
    assert stored.differences(stored) == []


def test_differences_of_comparisons_name_what_was_chosen_otherwise():
    stored = ComparePlan(world="dense", inject=("planning",), missions=10).spec()
    asked = ComparePlan(world="sparse", inject=("control",), missions=12, seed=2).spec()
    assert stored.differences(asked, "missions") == [
        "world dense there, sparse here",
        "stage planning there, control here",
        "missions 10 there, 12 here",
        "fault seed 1 there, 2 here",
    ]
