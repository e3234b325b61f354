"""The spread of repeated flights of a user's companion."""

import math
import re
import types

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from mavfi_cli.core.flight_record import QualityOfFlight
from mavfi_cli.studies.spread import Spread


def run(folder, outcome, time_s, east_m):
    """A flight 10 m north, `east_m` beside the axis, as its run folder has it."""
    folder.mkdir()
    north = np.linspace(0.0, 10.0, 11)
    columns = {"x_m": np.full(11, east_m), "y_m": north, "z_m": np.full(11, 5.0)}
    pq.write_table(pa.table(columns), folder / "trace.parquet")
    record = types.SimpleNamespace(
        outcome=outcome, succeeded=outcome == "success",
        quality_of_flight=QualityOfFlight(flight_time_s=time_s),
    )  # fmt: skip
    return types.SimpleNamespace(record=record, folder=types.SimpleNamespace(path=folder))


def test_outcomes_times_and_the_distance_between_paths(tmp_path):
    flights = [("success", 10.0, 0.0), ("crash", 3.0, 90.0), ("success", 12.0, 0.5),
               ("success", 11.0, 2.0)]  # fmt: skip
    spread = Spread.of([run(tmp_path / str(n), *own) for n, own in enumerate(flights)])
    assert spread.outcomes == {"success": 3, "crash": 1}
    assert spread.succeeded == pytest.approx((0.75, 0.3006, 0.9544), abs=1e-4)
    assert spread.flight_time_s == (10.0, 11.0, 12.0)
    assert spread.apart_m == pytest.approx((2.0, 2.0))
    assert re.search(r"crash 1, success 3.* 75\.0 % \(30\.1 to 95\.4\)", spread.lines()[0])


def test_nothing_is_known_of_flights_that_all_failed(tmp_path):
    spread = Spread.of([run(tmp_path / "0", "crash", 1.0, 0.0)])
    assert all(map(math.isnan, (*spread.flight_time_s, *spread.apart_m)))
    assert spread.as_dict()["apart_m"] == [None, None]
    assert len(spread.lines()) == 1
