"""Trains the autoencoder. Only this module needs torch: `pip install mavfi[train]`.

Adam minimises the mean squared reconstruction error of all distinct error-free vectors in one
batch, from several initial weights. The threshold will be a largest error, so the training keeps
the weights, over all epochs and starts, with the lowest largest error on the validation vectors. It
runs on one thread in double precision with a fixed seed, so the same data and the same version of
torch give the same weights.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np

from mavfi_cli.core.errors import ModelError
from mavfi_cli.core.types import FloatArray
from mavfi_cli.detect.autoencoder import CODED, HIDDEN
from mavfi_cli.detect.preprocess import COUNT

EPOCHS = 1000
STARTS = 5
LEARNING_RATE = 0.01
CURVE_EVERY = 20  # epochs between two points of the recorded loss curve


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainedWeights:
    """Weights, named as in `autoencoder.WEIGHTS`, and the provenance of the training."""

    weights: Mapping[str, FloatArray]
    provenance: Mapping[str, Any]


def require_torch() -> None:
    """Check that torch is installed, without the seconds that its import takes.

    Raises:
        ModelError: torch is not installed.
    """
    if find_spec("torch") is None:
        raise ModelError("training the autoencoder needs torch: pip install 'mavfi[train]'")


def train(inputs: FloatArray, validation: FloatArray, *, seed: int) -> TrainedWeights:
    """Train on scaled vectors (n, 13) and keep the best weights for the validation (m, 13).

    Args:
        inputs, validation: Scaled deltas, each vector once.
        seed: Seed of the first start; each further start uses the next.

    Raises:
        ModelError: torch is not installed.
    """
    require_torch()
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        starts = [_train(torch, inputs, validation, seed + number) for number in range(STARTS)]
    finally:
        torch.set_num_threads(threads)
    return min(starts, key=lambda start: float(start.provenance["validation_error"]))


def _train(torch: Any, inputs: FloatArray, validation: FloatArray, seed: int) -> TrainedWeights:
    """Train from one set of initial weights."""
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
    return TrainedWeights(
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
