from __future__ import annotations

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

from mavfi_cli.core.errors import RecordError, VehicleProcessError
from sitl.referee import Collision, Referee
from sitl.world.world import World

LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
WALL = [5.0, -9.0, 0.0, 5.01, 9.0, 20.0]


def world(*boxes: list[float]) -> World:
    return World(
        name="w",
        seed=3,
        boxes_enu_m=np.array(boxes).reshape(-1, 6),
        bounds_enu_m=np.array([-20.0, -20.0, 0.0, 40.0, 20.0, 50.0]),
        start_enu_m=np.zeros(3),
        goal_enu_m=np.array([20.0, 0.0, 5.0]),
    )


def referee(*boxes: list[float]) -> Referee:
    return Referee(world(*boxes), (0.5, 0.5, 0.16), vehicle="solo")


def see(
    watcher: Referee, stamp: float, x: float, z: float = 5.0, **flags: bool
) -> Collision | None:
    flags = {"armed": True, "on_ground": False, **flags}
    return watcher.observe(
        stamp, np.array([x, 0.0, z]), LEVEL, np.array([3.0, 0.0, 0.0]),
        power_regression_w=200.0, power_propeller_w=150.0, **flags,
    )  # fmt: skip


def test_a_collision_has_its_own_moment_and_place() -> None:
    watcher = referee(WALL)
    assert see(watcher, 1.0, 4.0) is None
    hit = see(watcher, 1.02, 6.0)
    assert hit is watcher.collision
    assert hit is not None
    assert hit.position_enu_m == pytest.approx((4.75, 0.0, 5.0), abs=1e-3)
    assert hit.stamp_s == pytest.approx(1.0 + 0.02 * 0.75 / 2.0, abs=1e-5)
    assert (hit.box_index, hit.what) == (0, "box 0")
    assert re.fullmatch(r"Collision: box 0 at 4\.[78] 0\.0 5\.0", hit.text)
    assert see(watcher, 1.04, 8.0) is None
    assert watcher.min_clearance_m == 0.0


def test_a_log_without_observations_has_empty_columns() -> None:
    assert {len(column) for column in referee().log().values()} == {0}


def test_hitting_the_ground_is_a_collision() -> None:
    watcher = referee()
    see(watcher, 0.0, 0.0)
    hit = see(watcher, 0.02, 0.0, 0.05)
    assert hit is not None
    assert (hit.what, hit.box_index) == ("ground", None)


def test_disarmed_on_the_ground_after_a_landing_is_none() -> None:
    watcher = referee()
    flights = [(0.11, True, True), (3.0, False, True), (0.11, True, True), (0.11, True, False)]
    for k, (z, on_ground, armed) in enumerate(flights):
        hit = watcher.observe(
            k * 0.02, np.array([0.0, 0.0, z]), LEVEL, np.array([0.0, 0.0, -0.5]),
            armed=armed, on_ground=on_ground, may_land=True,
        )  # fmt: skip
        assert hit is None


def test_distance_counts_while_armed_and_clearance_is_the_least() -> None:
    watcher = referee([5.0, 1.25, 0.0, 6.0, 2.0, 20.0])
    see(watcher, 0.0, -100.0, armed=False)
    see(watcher, 0.02, 0.0, armed=False)
    for k in range(1, 101):
        see(watcher, 0.02 + 0.02 * k, 0.1 * k)
    assert watcher.distance_m == pytest.approx(10.0)
    assert watcher.min_clearance_m == pytest.approx(1.0, abs=1e-3)


def test_a_state_that_is_no_number_ends_the_flight_in_one_line() -> None:
    watcher = referee(WALL)
    see(watcher, 0.0, 0.0)
    with pytest.raises(VehicleProcessError, match=r"at 0\.020 s .* not finite"):
        see(watcher, 0.02, math.nan)


def test_files_say_what_was_seen(tmp_path: Path) -> None:
    watcher = referee(WALL)
    for k in range(3000):
        see(watcher, 0.02 * k, 0.001 * k, on_ground=k == 0)
    folder = tmp_path / "truth"
    watcher.save(folder, {"regression": 12.5, "propeller": 9.0})
    report = json.loads((folder / "truth.json").read_text())
    assert report["collision"] is None
    assert report["distance_m"] == pytest.approx(2.999)
    assert report["energies_j"] == {"regression": 12.5, "propeller": 9.0}
    assert report["vehicle"] == "solo"
    assert report["world"]["boxes"] == [WALL]
    assert report["world"]["goal"] == [20.0, 0.0, 5.0]
    with np.load(folder / "truth.npz") as truth:
        shapes = {name: truth[name].shape for name in truth.files}
        assert shapes == {
            "stamp_s": (3000,),
            "position_enu_m": (3000, 3),
            "velocity_enu_mps": (3000, 3),
            "quaternion": (3000, 4),
            "clearance_m": (3000,),
            "power_regression_w": (3000,),
            "power_propeller_w": (3000,),
            "armed": (3000,),
            "on_ground": (3000,),
        }
        assert truth["clearance_m"] == pytest.approx(4.75 - 0.001 * np.arange(3000))
        assert np.flatnonzero(truth["on_ground"]).tolist() == [0]
        assert truth["armed"].dtype == np.bool_
    assert sorted(p.name for p in folder.iterdir()) == ["truth.json", "truth.npz"]


def test_the_collision_is_in_the_report() -> None:
    watcher = referee(WALL)
    see(watcher, 0.0, 4.0)
    see(watcher, 0.02, 6.0)
    collision = watcher.report()["collision"]
    assert collision["what"] == "box 0"
    assert collision["speed_mps"] == pytest.approx(3.0)
    assert json.loads(json.dumps(collision)) == {
        **collision,
        "position_enu_m": list(collision["position_enu_m"]),
    }


def test_without_boxes_the_clearance_is_none() -> None:
    watcher = referee()
    see(watcher, 0.0, 0.0)
    assert watcher.report()["min_clearance_m"] is None


def test_equal_flights_give_equal_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        watcher = referee(WALL)
        for k in range(50):
            see(watcher, 0.02 * k, 0.01 * k)
        watcher.save(tmp_path / name)
    for file in ("truth.npz", "truth.json"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_a_folder_that_cannot_be_written_is_one_line_and_keeps_the_old_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    with pytest.raises(RecordError, match="Not a directory"):
        referee().save(blocked / "truth")

    watcher = referee(WALL)
    see(watcher, 0.0, 0.0)
    watcher.save(tmp_path)
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}

    def full(_descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    see(watcher, 0.02, 1.0)
    with pytest.raises(RecordError, match="No space left on device"):
        watcher.save(tmp_path)
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before
