import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from detect_builders import STACK, plan, trace

from mavfi_cli.core.errors import ModelError, RecordError
from mavfi_cli.core.types import Stage
from mavfi_cli.detect.offline import Dataset, FlightSamples
from mavfi_cli.detect.preprocess import PreprocessParams


def dataset(count=3, params=None):
    params = params or PreprocessParams()
    flights = tuple(
        FlightSamples.of_trace(trace(4.0, seed), "w", seed, params, [plan(12)] * seed)
        for seed in range(count)
    )
    return Dataset(flights=flights, preprocess=params, stack=STACK)


def test_what_is_saved_is_loaded_and_equal_sets_give_equal_bytes(tmp_path):
    made = dataset()
    made.save(tmp_path / "a.parquet")
    loaded = Dataset.load(tmp_path / "a.parquet")
    assert len(loaded) == 3
    assert loaded.stack == STACK
    for one, other in zip(made.flights, loaded.flights, strict=True):
        assert (one.world, one.seed) == (other.world, other.seed)
        for name in ("stamps_s", "reports", "plan_steps", "new_waypoint", "deltas", "extended"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
            assert getattr(one, name).dtype == getattr(other, name).dtype
    loaded.save(tmp_path / "b.parquet")
    assert (tmp_path / "a.parquet").read_bytes() == (tmp_path / "b.parquet").read_bytes()


def test_an_empty_set_can_be_kept(tmp_path):
    Dataset(flights=(), preprocess=PreprocessParams(), stack=STACK).save(tmp_path / "none.parquet")
    assert len(Dataset.load(tmp_path / "none.parquet")) == 0


def test_samples_of_a_stage_are_those_that_bring_something_new():
    for plans, flight in enumerate(dataset(3).flights):
        assert flight.of_stage(Stage.CONTROL).shape == (200, 13)
        assert flight.of_stage(Stage.PLANNING).shape == (8 + 11 * plans, 13)
        assert flight.of_stage(Stage.PERCEPTION).shape == (14, 13)


def test_a_flight_can_be_in_a_set_only_once():
    (flight,) = dataset(1).flights
    with pytest.raises(ModelError, match="only once"):
        Dataset(flights=(flight, flight), preprocess=PreprocessParams(), stack=STACK)


def test_what_is_no_data_set_is_refused(tmp_path):
    path = tmp_path / "x.parquet"
    with pytest.raises(RecordError, match="cannot be read"):
        Dataset.load(path)
    path.write_bytes(b"nonsense")
    with pytest.raises(RecordError, match="cannot be read"):
        Dataset.load(path)
    pq.write_table(pa.table({"a": [1]}), path)
    with pytest.raises(ModelError, match="not a mavfi data set"):
        Dataset.load(path)
    dataset(params=PreprocessParams(yaw_floor=-5)).save(path)
    with pytest.raises(ModelError, match="preprocessing"):
        Dataset.load(path)
    assert len(Dataset.load(path, PreprocessParams(yaw_floor=-5))) == 3
