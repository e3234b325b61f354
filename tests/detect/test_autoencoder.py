import numpy as np

from mavfi_cli.core.types import Stage
from mavfi_cli.detect import base
from mavfi_cli.detect.autoencoder import AutoencoderDetector
from mavfi_cli.detect.baselines import NormDetector, RangeDetector
from mavfi_cli.detect.preprocess import COUNT


def test_inference_is_that_of_the_net_written_in_numpy():
    rng = np.random.default_rng(2)
    arrays = {name: rng.normal(size=shape) for name, shape in AutoencoderDetector.shapes.items()}
    arrays["scale"] = rng.uniform(1, 5, COUNT)
    detector = AutoencoderDetector(arrays)
    for deltas in rng.integers(-9, 10, size=(50, COUNT)).astype(np.int16):
        x = deltas / arrays["scale"]
        h = np.tanh(arrays["hidden_weights"] @ x + arrays["hidden_biases"])
        c = np.tanh(arrays["coded_weights"] @ h + arrays["coded_biases"])
        y = arrays["output_weights"] @ c + arrays["output_biases"]
        np.testing.assert_allclose(
            detector.score(deltas, Stage.CONTROL), ((y - x) ** 2).mean(), rtol=1e-12
        )


def test_the_net_is_the_papers():
    shapes = AutoencoderDetector.shapes
    assert shapes["hidden_weights"] == (6, 13)
    assert shapes["coded_weights"] == (3, 6)
    assert shapes["output_weights"] == (13, 3)


def test_it_reconstructs_changes_of_either_sign():
    """A delta is smaller after reconstruction than if the net put out nothing at all."""
    detector = base.find_detector("aad")
    scale = detector.memory["scale"]
    for sign in (1, -1):
        deltas = np.zeros(COUNT, np.int16)
        deltas[[2, 3]] = sign  # a waypoint over the next octave in x and in y
        assert detector.score(deltas, Stage.CONTROL) < ((deltas / scale) ** 2).mean()


def test_the_baselines_are_what_they_say():
    norm = NormDetector({"threshold": np.array([2.0]), "scale": np.full(COUNT, 2.0)})
    deltas = np.zeros(COUNT, np.int16)
    deltas[[0, 12]] = 6, 8
    assert norm.score(deltas, Stage.CONTROL) == 5.0
    lowest, highest = np.full(COUNT, -1.0), np.full(COUNT, 3.0)
    span = RangeDetector({"margin": np.array([0.5]), "lowest": lowest, "highest": highest})
    for value, outside in ((-3, 2.0), (-1, 0.0), (3, 0.0), (4, 1.0)):
        deltas[:] = 0
        deltas[12] = value
        assert span.score(deltas, Stage.CONTROL) == outside
        assert span.score(deltas, Stage.PLANNING) == 0.0
