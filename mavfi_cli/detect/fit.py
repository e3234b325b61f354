"""Fits models to a data set of error-free flights.

Flights are split by seed into three disjoint parts: `train` fits weights, means and scales,
`validation` selects the epoch of the autoencoder, and `threshold` sets the thresholds.

Only the autoencoder needs torch: `pip install mavfi[train]`. Adam minimises the mean squared
reconstruction error of all distinct error-free vectors in one batch, from several initial weights.
The threshold will be a largest error, so the training keeps the weights, over all epochs and
starts, with the lowest largest error on the validation vectors. It runs on one thread in double
precision with a fixed seed, so the same data and the same version of torch give the same weights.
"""

from __future__ import annotations

import itertools
import math
import platform
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.errors import ModelError, UnknownName
from mavfi_cli.core.seeds import Stream, generator
from mavfi_cli.core.types import DType, FloatArray, Stage
from mavfi_cli.detect import gaussian, span
from mavfi_cli.detect.autoencoder import CODED, HIDDEN, AutoencoderDetector
from mavfi_cli.detect.base import Detector
from mavfi_cli.detect.dataset import Dataset, FlightSamples
from mavfi_cli.detect.gaussian import GaussianDetector
from mavfi_cli.detect.model import Model, checked_threshold
from mavfi_cli.detect.norm import NormDetector
from mavfi_cli.detect.preprocess import COUNT, DETECTED, NAMES, Codes
from mavfi_cli.detect.span import RangeDetector
from mavfi_cli.detect.watch import ranges_of

FLIGHTS_MIN = 10
# Cycle of the split: of ten flights, five train, one validates and four set thresholds.
_TURNS = ("train", "threshold") * 4 + ("train", "validation")
# Two reports can arrive between two ticks, so a sequence number may increase by two.
_LEAST_SCALE = np.array([2 if s.dtype is DType.INT32 else 1 for s in DETECTED])
_X, _Y = ([NAMES.index(f"{prefix}{axis}") for prefix in ("waypoint_", "waypoint_v", "command_v")]
          for axis in "xy")  # fmt: skip
_YAW = [NAMES.index("waypoint_yaw"), NAMES.index("command_yaw")]
KINDS = ("gad", "aad", "range", "l2")


def split(dataset: Dataset, seed: int) -> dict[str, list[int]]:
    """Split by flight, in the same way for each world. Return the indices by their use.

    Raises:
        ModelError: There are fewer than FLIGHTS_MIN flights.
    """
    _refuse_few(len(dataset))
    drawn = generator(seed, Stream.MISSION, "detector-split").permutation(len(dataset))
    worlds = [dataset.flights[place].world for place in drawn]
    ordered = [int(drawn[i]) for i in sorted(range(len(drawn)), key=lambda i: (worlds[i], i))]
    parts: dict[str, list[int]] = {"train": [], "validation": [], "threshold": []}
    for number, place in enumerate(ordered):
        parts[_TURNS[number % len(_TURNS)]].append(place)
    return {name: sorted(places) for name, places in parts.items()}


def check(kinds: Collection[str], flights: int, n_sigma: float | None = None) -> None:
    """Check before the flights that `fit` will be able to use them.

    Raises:
        UnknownName: A kind is unknown.
        ModelError: There are too few flights, or torch is missing for aad.
        ConfigError: n sigma is out of range.
    """
    for kind in kinds:
        if kind not in KINDS:
            raise UnknownName("detector", kind, KINDS)
    _refuse_few(flights)
    if n_sigma is not None:
        checked_threshold(n_sigma, "n sigma")
    if "aad" in kinds:
        _require_torch()


def _refuse_few(flights: int) -> None:
    if flights < FLIGHTS_MIN:
        raise ModelError(f"{flights} flights are too few to fit to: {FLIGHTS_MIN} at least")


def fit(kind: str, dataset: Dataset, *, seed: int = 1, n_sigma: float | None = None) -> Model:
    """Fit one kind of detector.

    Args:
        n_sigma: Threshold of the Gaussian model. None selects the smallest integer that the
            flights of the third part do not exceed, and at least `gaussian.N_SIGMA`.

    Raises:
        UnknownName: The kind is unknown.
        ModelError: There are too few flights, or torch is missing for aad.
        ConfigError: n sigma is out of range.
    """
    parts = split(dataset, seed)
    flights = dataset.flights
    train, validation, held_out = ([flights[place] for place in parts[use]] for use in parts)
    details: dict[str, Any] = {}
    detector: Any
    if kind == "gad":
        given = gaussian.N_SIGMA if n_sigma is None else checked_threshold(n_sigma, "n sigma")
        detector = GaussianDetector.cold(given)
        for flight, stage in itertools.product([*train, *validation], Stage):
            for deltas in flight.of_stage(stage):
                detector.learn(deltas, stage)
        largest = _largest(detector, held_out)
        details["largest_distance_sigma"] = largest
        if n_sigma is None:
            detector.memory["n_sigma"][0] = max(gaussian.N_SIGMA, math.ceil(largest))
    elif kind == "range":
        everything = mirrored(_all(list(flights)))
        detector = RangeDetector(
            {
                "margin": np.array([span.MARGIN]),
                "lowest": np.minimum(everything.min(axis=0), 0).astype(np.float64),
                "highest": np.maximum(everything.max(axis=0), 0).astype(np.float64),
            }
        )
    elif kind == "l2":
        detector = NormDetector({"threshold": np.ones(1), "scale": scale_of(train)})
        detector.memory["threshold"][0] = _largest(detector, held_out)
    elif kind == "aad":
        scale = scale_of(train)
        trained = train_autoencoder(
            mirrored(_all(train)) / scale, mirrored(_all(validation)) / scale, seed=seed
        )
        detector = AutoencoderDetector({"threshold": np.ones(1), "scale": scale, **trained.weights})
        detector.memory["threshold"][0] = _largest(detector, held_out)
        details.update(trained.provenance)
    else:
        raise UnknownName("detector", kind, KINDS)
    arrays = {name: np.array(array) for name, array in detector.memory.items()}
    return Model(
        detector=kind,
        arrays=arrays,
        stack=dataset.stack,
        extended=ranges_of(np.concatenate([flight.extended for flight in flights])),
        preprocess=dataset.preprocess,
        provenance=_provenance(dataset, parts, seed, detector.threshold, details),
    )


def scale_of(flights: list[FlightSamples]) -> FloatArray:
    """Return the largest |delta| in each state's group (COUNT,), at least 1.

    The scaled inputs lie within about +-1. The components of a vector share one scale, because each
    component may take the values of the others.
    """
    rows = mirrored(_all(flights))
    largest = np.maximum(np.abs(rows).max(axis=0), _LEAST_SCALE)
    groups = np.array([state.group for state in DETECTED])
    return np.array([largest[groups == group].max() for group in groups], np.float64)


def mirrored(deltas: Codes) -> NDArray[np.int64]:
    """Return the distinct rows (m, COUNT) of the deltas (n, COUNT) and their mirror images.

    The training worlds have their goals north-east of the start, but no direction is special. The
    images mirror east, mirror north, and swap the two. A mirrored velocity or position has the
    negated code. Yaw is negated with north. Its delta stays unchanged under the other two, which is
    an approximation.
    """
    rows = np.unique(deltas.astype(np.int64), axis=0)
    images = []
    for swapped in (False, True):
        turned = rows.copy()
        if swapped:
            turned[:, _X], turned[:, _Y] = rows[:, _Y], rows[:, _X]
        for east in (1, -1):
            for north in (1, -1):
                image = turned.copy()
                image[:, _X] *= east
                image[:, [*_Y, *_YAW]] *= north
                images.append(image)
    return np.unique(np.concatenate(images), axis=0)


def scores(detector: Detector, flight: FlightSamples) -> FloatArray:
    """Return the score of every judged message (n,): the highest score of its stages."""
    found = np.zeros(len(flight.deltas))
    flags = (flight.reports, flight.plan_steps, flight.new_waypoint)
    rows = zip(flight.deltas, *(flag.tolist() for flag in flags), strict=True)
    for row, (deltas, report, step, new) in enumerate(rows):
        if report:
            found[row] = detector.score(deltas, Stage.PERCEPTION)
            continue
        if not (step and detector.per_stage):
            found[row] = detector.score(deltas, Stage.CONTROL)
        if (new or step) and detector.per_stage:
            found[row] = max(found[row], detector.score(deltas, Stage.PLANNING))
    return found


def _all(flights: list[FlightSamples]) -> Codes:
    return np.concatenate([flight.deltas for flight in flights])


def _largest(detector: Detector, flights: list[FlightSamples]) -> float:
    """Return the largest score of the flights.

    For a detector with one score over all states it includes the mirror images.
    """
    if detector.per_stage:
        return max(float(scores(detector, flight).max(initial=0.0)) for flight in flights)
    rows = mirrored(_all(flights)).astype(np.int16)
    return max(detector.score(deltas, Stage.CONTROL) for deltas in rows)


def _provenance(
    dataset: Dataset,
    parts: Mapping[str, Sequence[int]],
    seed: int,
    threshold: float,
    details: Mapping[str, Any],
) -> dict[str, Any]:
    names = [f"{flight.world}/{flight.seed}" for flight in dataset.flights]
    return {
        "flights": len(dataset),
        "samples": sum(len(flight.deltas) for flight in dataset.flights),
        "worlds": sorted({flight.world for flight in dataset.flights}),
        "split": {use: [names[place] for place in places] for use, places in parts.items()},
        "seed": seed,
        "threshold": threshold,
        "versions": {
            "python": platform.python_version(),
            "numpy": np.__version__,
            **details.get("versions", {}),
        },
        **{name: value for name, value in details.items() if name != "versions"},
    }


EPOCHS = 1000
STARTS = 5
LEARNING_RATE = 0.01
CURVE_EVERY = 20  # epochs between two points of the recorded loss curve


@dataclass(frozen=True, slots=True, kw_only=True)
class _TrainedWeights:
    """Weights, named as in `autoencoder.WEIGHTS`, and the provenance of the training."""

    weights: Mapping[str, FloatArray]
    provenance: Mapping[str, Any]


def _require_torch() -> None:
    """Check that torch is installed, without the seconds that its import takes."""
    if find_spec("torch") is None:
        raise ModelError("training the autoencoder needs torch: pip install 'mavfi[train]'")


def train_autoencoder(inputs: FloatArray, validation: FloatArray, *, seed: int) -> _TrainedWeights:
    """Train on scaled vectors (n, 13) and keep the best weights for the validation (m, 13).

    Raises:
        ModelError: torch is not installed.
    """
    _require_torch()
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        starts = [_train_once(torch, inputs, validation, seed + number) for number in range(STARTS)]
    finally:
        torch.set_num_threads(threads)
    return min(starts, key=lambda start: float(start.provenance["validation_error"]))


def _train_once(
    torch: Any, inputs: FloatArray, validation: FloatArray, seed: int
) -> _TrainedWeights:
    source = torch.Generator().manual_seed(seed)
    sizes = ((COUNT, HIDDEN), (HIDDEN, CODED), (CODED, COUNT))
    names = ("hidden", "coded", "output")
    weights = {}
    for name, (before, after) in zip(names, sizes, strict=True):
        reach = (6.0 / (before + after)) ** 0.5  # Glorot, uniform
        drawn = torch.rand((after, before), generator=source, dtype=torch.float64)
        weights[f"{name}_weights"] = (reach * (2.0 * drawn - 1.0)).requires_grad_()
        weights[f"{name}_biases"] = torch.zeros(after, dtype=torch.float64).requires_grad_()

    def loss_of(rows: Any) -> Any:
        """Return the mean squared error (n,) of each of the vectors (n, COUNT)."""
        hidden = torch.tanh(rows @ weights["hidden_weights"].T + weights["hidden_biases"])
        coded = torch.tanh(hidden @ weights["coded_weights"].T + weights["coded_biases"])
        output = coded @ weights["output_weights"].T + weights["output_biases"]
        return ((output - rows) ** 2).mean(dim=1)  # one error per vector

    rows, checked = torch.tensor(inputs), torch.tensor(validation)
    optimiser = torch.optim.Adam(list(weights.values()), lr=LEARNING_RATE)
    best, best_epoch, kept = np.inf, 0, {}
    curve: list[list[float]] = []
    for epoch in range(EPOCHS + 1):
        with torch.no_grad():
            met = float(loss_of(checked).max())
        if met < best:
            best, best_epoch = met, epoch
            kept = {name: w.detach().numpy().copy() for name, w in weights.items()}
        loss = loss_of(rows).mean()
        if epoch % CURVE_EVERY == 0:
            curve.append([epoch, float(loss.detach()), met])
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return _TrainedWeights(
        weights=kept,
        provenance={
            "epochs": EPOCHS,
            "learning_rate": LEARNING_RATE,
            "best_epoch": best_epoch,
            "validation_error": best,
            "starts": STARTS,
            "start_seed": seed,
            "distinct_vectors": {"train": len(inputs), "validation": len(validation)},
            "loss_curve": {"columns": ["epoch", "train_mean", "validation_largest"], "rows": curve},
            "versions": {"torch": str(torch.__version__)},
        },
    )
