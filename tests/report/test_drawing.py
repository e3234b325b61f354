"""What pictures share: one colour a detector, a scheme, a platform; and only SVG."""

from itertools import combinations
from types import SimpleNamespace as Namespace

import numpy as np
import pytest
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure

from mavfi_cli.core.errors import RecordError
from mavfi_cli.report import detectors, model
from mavfi_cli.report.drawing import (
    DETECTORS,
    NONE,
    PLATFORMS,
    REDUNDANCY,
    detector_colours,
    write_figure,
)
from mavfi_cli.stats.shares import Share
from mavfi_cli.vpm.model import SCHEMES, ModelVehicle
from mavfi_cli.vpm.report import Choices, report


def test_no_two_things_look_alike():
    palette = [NONE, *DETECTORS.values(), *REDUNDANCY.values(), *PLATFORMS]
    for first, second in combinations(palette, 2):
        distance = np.linalg.norm(np.subtract(to_rgb(first), to_rgb(second)))
        assert distance > 0.2, (first, second)


def test_a_detector_of_another_package_takes_none_of_these():
    found = detector_colours(["none", "mine", "gad", "yours"])
    assert found["none"] == NONE
    assert found["gad"] == DETECTORS["gad"]
    assert found["mine"] != found["yours"]
    assert not {found["mine"], found["yours"]} & {*DETECTORS.values(), *REDUNDANCY.values()}


def undone(detector, by, value, total, active, protected):
    share = 0.5 if total else np.nan
    return Namespace(
        detector=detector, by=by, value=value, active=active,
        undone=Share(share=share, low=0.2, high=0.8, count=0, total=total),
        worst=Namespace(protected=protected),
    )  # fmt: skip


@pytest.fixture
def evaluated():
    rows = []
    for detector in ("none", "gad", "aad"):
        rows += [
            undone(detector, "stage", "planning", 4, 9, 1.2),
            undone(detector, "stage", "control", 0, 9, 1.2),
            undone(detector, "world", "sparse", 4, 0, np.nan),
            undone(detector, "world", "dense", 4, 9, np.nan if detector == "gad" else 1.3),
        ]
    return Namespace(faults=rows)


def test_a_detector_looks_the_same_in_every_picture(evaluated):
    shares, _ = detectors.PICTURES["recovery.svg"](evaluated).axes
    assert {to_hex(bar.get_facecolor()) for bar in shares.patches[:2]} == {
        DETECTORS["gad"], DETECTORS["aad"],
    }  # fmt: skip
    told = report([ModelVehicle.load("spark")], Choices(), SCHEMES)
    (axes,) = model.MODEL_PICTURES["redundancy.svg"](told).axes
    named = {
        container.get_label(): to_hex(container.patches[0].get_facecolor())
        for container in axes.containers
    }
    assert named == {
        "no protection": NONE,
        "DMR": REDUNDANCY["dmr"],
        "TMR": REDUNDANCY["tmr"],
        "detection (Gaussian)": DETECTORS["gad"],
        "detection (autoencoder)": DETECTORS["aad"],
    }


def test_a_group_of_nothing_is_empty_and_says_so_once(evaluated):
    """Its tick has n = 0; where there were flights, and none succeeded, that is written."""
    shares, times = detectors.PICTURES["recovery.svg"](evaluated).axes
    assert [text.get_text() for text in shares.texts] == []
    assert [label.get_text() for label in shares.get_xticklabels()] == [
        "planning\nn = 4", "control\nn = 0",
    ]  # fmt: skip
    assert [text.get_text() for text in times.texts] == ["no success"]


@pytest.mark.parametrize("name", ["picture.jpg", "picture", "picture.svg.txt"])
def test_the_name_of_a_picture_says_its_format(tmp_path, name):
    with pytest.raises(RecordError, match=rf"{name}: .*\.svg, \.pdf or"):
        write_figure(Figure(), tmp_path / name)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(RecordError, match="its folder does not exist"):
        write_figure(Figure(), tmp_path / "none" / "picture.svg")
    write_figure(Figure(), tmp_path / "picture.SVG")
    assert (tmp_path / "picture.SVG").read_bytes().startswith(b"<?xml")
