"""Fits models to a data set of error-free flights.

A seeded shuffle splits the flights into three disjoint parts: `train` fits weights, means and
scales, `validation` selects the epoch of the autoencoder, and `threshold` sets the thresholds. The
Gaussian model also learns from `validation`. The ranges of `range` cover all flights.

Only the autoencoder needs torch: `pip install mavfi[train]`. Adam minimises the mean squared
reconstruction error of all distinct training vectors in one batch, starting from several sets of
random weights. The threshold will be the largest error, so training keeps the weights whose largest
error on the validation vectors is lowest over all epochs and starts. It runs on one thread in
double precision with a fixed seed, so the same data and version of torch give the same weights.
"""

from __future__ import annotations

import itertools
import math
import platform
from collections.abc import Collection, Mapping, Sequence
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.errors import ModelError, UnknownName
from mavfi_cli.core.seeds import Stream
from mavfi_cli.core.types import DType, FloatArray, Stage
from mavfi_cli.detect import baselines, gaussian
from mavfi_cli.detect.autoencoder import CODED, HIDDEN, AutoencoderDetector
from mavfi_cli.detect.base import Detector, Model, checked_threshold
from mavfi_cli.detect.baselines import NormDetector, RangeDetector
from mavfi_cli.detect.offline import Dataset, FlightSamples
from mavfi_cli.detect.preprocess import COUNT, DETECTED, EXTENDED, NAMES, Ranges

FLIGHTS_MIN = 10
KINDS = ("gad", "aad", "range", "l2")
# Cycle of the split: of ten flights, five train, one validates and four set thresholds.
_TURNS = ("train", "threshold") * 4 + ("train", "validation")
# The Gaussian model keeps learning in flight, so the score of the same step changes.
_LEARNING = 1.02
# Two reports can arrive between two ticks, so a sequence number may increase by two.
_LEAST_SCALE = np.array([2 if s.dtype is DType.INT32 else 1 for s in DETECTED])
_X, _Y = ([NAMES.index(f"{prefix}{axis}") for prefix in ("waypoint_", "waypoint_v", "command_v")]
          for axis in "xy")  # fmt: skip
_YAW = [NAMES.index("waypoint_yaw"), NAMES.index("command_yaw")]


def check(kinds: Collection[str], flights: int, n_sigma: float | None = None) -> None:
    """Check the arguments of `fit`, so that errors appear before any flight is flown.

    Raises:
        UnknownName: A kind is unknown.
        ModelError: There are too few flights, or torch is missing for aad.
        ConfigError: `n_sigma` is not a finite number above 0.
    """
    for kind in kinds:
        if kind not in KINDS:
            raise UnknownName("detector", kind, KINDS)
    if flights < FLIGHTS_MIN:
        raise ModelError(f"the number of flights must be at least {FLIGHTS_MIN}, got {flights}")
    if n_sigma is not None:
        checked_threshold(n_sigma, "n sigma")
    if "aad" in kinds and find_spec("torch") is None:  # its import would take seconds
        raise ModelError("training the autoencoder needs torch: pip install 'mavfi[train]'")


def fit(kind: str, dataset: Dataset, *, seed: int = 1, n_sigma: float | None = None) -> Model:
    """Fit a model of one kind of detector to a data set. Raises the same errors as `check`.

    Args:
        n_sigma: Threshold of the Gaussian model. None selects the smallest integer that is at least
            2 % above all scores of the part `threshold`, but no less than `gaussian.N_SIGMA`.
    """
    check([kind], len(dataset), n_sigma)
    flights, parts = dataset.flights, _split(dataset, seed)
    train, validation, held_out = ([flights[place] for place in parts[use]] for use in parts)
    details: Mapping[str, Any] = {}
    detector: Any
    if kind == "gad":
        detector = gaussian.GaussianDetector.cold(n_sigma or gaussian.N_SIGMA)
        for flight, stage in itertools.product([*train, *validation], Stage):
            for deltas in flight.of_stage(stage):
                detector.learn(deltas, stage)
        largest = _largest(detector, held_out)
        details = {"largest_distance_sigma": largest}
        if n_sigma is None:
            detector.flat[0] = max(gaussian.N_SIGMA, math.ceil(_LEARNING * largest))
    elif kind == "range":
        rows = _mirrored(flights)
        lowest, highest = np.minimum(rows.min(axis=0), 0), np.maximum(rows.max(axis=0), 0)
        margin = np.array([baselines.MARGIN])
        detector = RangeDetector({"margin": margin, "lowest": lowest, "highest": highest})
    else:
        scale = _scale_of(train)
        arrays = {"threshold": np.ones(1), "scale": scale}
        if kind == "l2":
            detector = NormDetector(arrays)
        else:
            weights, details = _train_autoencoder(
                _mirrored(train) / scale, _mirrored(validation) / scale, seed
            )
            detector = AutoencoderDetector({**arrays, **weights})
        detector.flat[0] = _largest(detector, held_out)
    return Model(
        detector=kind,
        arrays={name: np.array(array) for name, array in detector.memory.items()},
        stack=dataset.stack,
        extended=_extended_ranges(flights),
        preprocess=dataset.preprocess,
        provenance=_provenance(dataset, parts, seed, detector.threshold, details),
    )


def _split(dataset: Dataset, seed: int) -> dict[str, list[int]]:
    """Split the flights into the parts `train`, `validation` and `threshold`.

    The proportions are similar for each world. Return the indices of the flights in each part,
    keyed by the part's name.
    """
    drawn = Stream.MISSION.generator(seed, "detector-split").permutation(len(dataset))
    worlds = [dataset.flights[place].world for place in drawn]
    ordered = [int(drawn[i]) for i in sorted(range(len(drawn)), key=lambda i: (worlds[i], i))]
    parts: dict[str, list[int]] = {"train": [], "validation": [], "threshold": []}
    for number, place in enumerate(ordered):
        parts[_TURNS[number % len(_TURNS)]].append(place)
    return {name: sorted(places) for name, places in parts.items()}


def _scale_of(flights: Sequence[FlightSamples]) -> FloatArray:
    """Return the scale (COUNT,) of each state: the largest |delta| in its group of states.

    A scale is never below the state's entry in `_LEAST_SCALE`. The scaled inputs lie within about
    +-1. The components of a vector share one scale, because each component may take the values of
    the others.
    """
    largest = np.maximum(np.abs(_mirrored(flights)).max(axis=0), _LEAST_SCALE)
    groups = np.array([state.group for state in DETECTED])
    return np.array([largest[groups == group].max() for group in groups], np.float64)


def _mirrored(flights: Sequence[FlightSamples]) -> NDArray[np.int64]:
    """Return the distinct deltas (m, COUNT) of the flights and their mirror images.

    In the training worlds, the goal lies north-east of the start, but no direction is special. The
    images negate east, negate north, swap the two, or combine these. A negated velocity or position
    has the negated code. Negating north also negates yaw. The other two leave the yaw delta
    unchanged, which is an approximation.
    """
    deltas = np.concatenate([flight.deltas for flight in flights])
    rows = np.unique(deltas.astype(np.int64), axis=0)
    swapped = rows.copy()
    swapped[:, _X], swapped[:, _Y] = rows[:, _Y], rows[:, _X]
    images = []
    for turned, east, north in itertools.product((rows, swapped), (1, -1), (1, -1)):
        image = turned.copy()
        image[:, _X] *= east
        image[:, [*_Y, *_YAW]] *= north
        images.append(image)
    return np.unique(np.concatenate(images), axis=0)


def _largest(detector: Detector, flights: Sequence[FlightSamples]) -> float:
    """Return the largest score that the detector gives to a sample of the flights.

    For a detector with one score over all states, mirror images of the samples are included.
    """
    if detector.per_stage:
        return max(float(flight.scores(detector).max(initial=0.0)) for flight in flights)
    rows = _mirrored(flights).astype(np.int16)
    return max(detector.score(deltas, Stage.CONTROL) for deltas in rows)


def _extended_ranges(flights: Sequence[FlightSamples]) -> Ranges:
    """Return the smallest and largest change of each extended state in the flights.

    The ranges are keyed by the state's name, and always include 0.
    """
    rows = np.concatenate([flight.extended for flight in flights])
    return {
        state.name: (min(0, *column), max(0, *column))
        for state, column in zip(EXTENDED, rows.T.tolist(), strict=True)
    }


def _provenance(
    dataset: Dataset,
    parts: Mapping[str, Sequence[int]],
    seed: int,
    threshold: float,
    details: Mapping[str, Any],
) -> dict[str, Any]:
    names = [f"{flight.world}/{flight.seed}" for flight in dataset.flights]
    versions = {"python": platform.python_version(), "numpy": np.__version__}
    return {
        "flights": len(dataset),
        "samples": sum(len(flight.deltas) for flight in dataset.flights),
        "worlds": sorted({flight.world for flight in dataset.flights}),
        "split": {use: [names[place] for place in places] for use, places in parts.items()},
        "seed": seed,
        "threshold": threshold,
        **details,
        "versions": {**versions, **details.get("versions", {})},
    }


EPOCHS = 1000
STARTS = 5
LEARNING_RATE = 0.01
CURVE_EVERY = 20  # epochs between two points of the recorded loss curve
Trained = tuple[dict[str, FloatArray], dict[str, Any]]  # weights by name, and their provenance


def _train_autoencoder(inputs: FloatArray, validation: FloatArray, seed: int) -> Trained:
    """Train an autoencoder on scaled deltas (n, 13) from several starts, and return the best.

    The best weights have the smallest largest error on the scaled deltas `validation` (m, 13).
    """
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        starts = [_train_once(torch, inputs, validation, seed + number) for number in range(STARTS)]
    finally:
        torch.set_num_threads(threads)
    return min(starts, key=lambda start: float(start[1]["validation_error"]))


def _train_once(torch: Any, inputs: FloatArray, validation: FloatArray, seed: int) -> Trained:
    source = torch.Generator().manual_seed(seed)
    sizes = {"hidden": (COUNT, HIDDEN), "coded": (HIDDEN, CODED), "output": (CODED, COUNT)}
    weights = {}
    for name, (before, after) in sizes.items():
        reach = (6.0 / (before + after)) ** 0.5  # Glorot, uniform
        drawn = torch.rand((after, before), generator=source, dtype=torch.float64)
        weights[f"{name}_weights"] = (reach * (2.0 * drawn - 1.0)).requires_grad_()
        weights[f"{name}_biases"] = torch.zeros(after, dtype=torch.float64).requires_grad_()

    def loss_of(rows: Any) -> Any:
        """Return the mean squared reconstruction error (n,) of each vector in `rows` (n, COUNT)."""
        hidden = torch.tanh(rows @ weights["hidden_weights"].T + weights["hidden_biases"])
        coded = torch.tanh(hidden @ weights["coded_weights"].T + weights["coded_biases"])
        output = coded @ weights["output_weights"].T + weights["output_biases"]
        return ((output - rows) ** 2).mean(dim=1)

    rows, checked = torch.tensor(inputs), torch.tensor(validation)
    optimiser = torch.optim.Adam(list(weights.values()), lr=LEARNING_RATE)
    best, best_epoch, kept = np.inf, 0, {}
    curve: list[list[float]] = []
    for epoch in range(EPOCHS + 1):
        with torch.no_grad():
            error = float(loss_of(checked).max())
        if error < best:
            best, best_epoch = error, epoch
            kept = {name: w.detach().numpy().copy() for name, w in weights.items()}
        loss = loss_of(rows).mean()
        if epoch % CURVE_EVERY == 0:
            curve.append([epoch, float(loss.detach()), error])
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return kept, {
        "epochs": EPOCHS,
        "learning_rate": LEARNING_RATE,
        "best_epoch": best_epoch,
        "validation_error": best,
        "starts": STARTS,
        "start_seed": seed,
        "distinct_vectors": {"train": len(inputs), "validation": len(validation)},
        "loss_curve": {"columns": ["epoch", "train_mean", "validation_largest"], "rows": curve},
        "versions": {"torch": str(torch.__version__)},
    }
