"""Minimum-snap smoothing, as in the released planner of MAVFI.

The released motion_planner.cpp (MAVBench/MAV_apps, branch mavfi, commit d505f3c) calls the linear
solver of mav_trajectory_generation (Richter, Bry and Roy 2013) with these conditions:

- The trajectory passes every vertex of the path. It starts with the given velocity and ends at
  rest. All other derivatives are free.
- It minimises the integral of the squared snap, the fourth derivative of position. The minimum is
  the spline of degree 7 with six continuous derivatives whose fourth and fifth derivatives vanish
  at both ends. A single segment is therefore a cubic.
- A segment of length d lasts 2 d / v (1 + 6.5 v / a exp(-2 d / v)), with v = v_max and a = a_max:
  33 s for 50 m, and 2.0 s for 1 m.
- A segment that is not free gets a vertex in the middle of its straight line, and the whole path is
  solved again, up to 40 times. More vertices mean shorter segments, so the vehicle is slow where
  the path is narrow.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np

from mavfi_cli.core.compiled import compiled
from mavfi_cli.core.frames import norm
from mavfi_cli.core.types import FloatArray

_TIME_FACTOR = 6.5  # `magic_fabian_constant` of the release
_CHECK_STEP_S = 0.1  # time between two points of the release's collision test
_SHORTEST_M = 0.1  # a vertex closer to its predecessor or to the end is left out
_TERMS = 8  # coefficients of a polynomial of degree 7
_REACH = 10  # farthest non-zero entry from the diagonal of the spline's equations


@dataclass(frozen=True, slots=True, kw_only=True)
class MinimumSnap:
    """A minimum-snap curve through the vertices of a path."""

    durations_s: FloatArray  # (n - 1,) of the segments
    coefficients: FloatArray  # (n - 1, 8, 3) in u = t / duration, 0..1, for each segment
    free: bool  # True if all of the curve lies in free space

    @classmethod
    def through(
        cls,
        path_enu_m: FloatArray,
        velocity_enu_mps: FloatArray,
        is_free: Callable[[FloatArray], bool],
        *,
        v_max_mps: float,
        a_max_mps2: float,
        passes_max: int,
    ) -> Self:
        """Fit a curve to a free path (n, 3). It begins with a velocity (3,) and ends at rest.

        Args:
            is_free: Returns True if a polyline (k, 3) lies in free space.
            passes_max: Maximum number of passes. Each pass after the first adds a vertex.
        """
        vertices = _distinct(path_enu_m)
        for _ in range(passes_max):
            durations_s = _segment_durations(vertices, v_max_mps, a_max_mps2)
            coefficients = _solve(vertices, durations_s, velocity_enu_mps)
            blocked = _first_blocked(coefficients, durations_s, is_free)
            if blocked is None:
                break
            middle = 0.5 * (vertices[blocked] + vertices[blocked + 1])
            vertices = np.insert(vertices, blocked + 1, middle, axis=0)
        return cls(durations_s=durations_s, coefficients=coefficients, free=blocked is None)

    def sampled(self, period_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return position, velocity and acceleration, each (k, 3), every `period_s` seconds.

        The first sample is at time 0.
        """
        count = max(1, math.floor(float(self.durations_s.sum()) / period_s))
        times_s = np.arange(count, dtype=np.float64) * period_s
        position, velocity, acceleration = (
            _evaluate(self.coefficients, self.durations_s, times_s, order) for order in range(3)
        )
        return position, velocity, acceleration


def _distinct(path: FloatArray) -> FloatArray:
    """Return the path (n, 3) without inner vertices too close to their predecessor or the end."""
    kept = [path[0]]
    for vertex in path[1:-1]:
        if min(norm(vertex - kept[-1]), norm(path[-1] - vertex)) > _SHORTEST_M:
            kept.append(vertex)
    return np.vstack([*kept, path[-1]])


def _segment_durations(vertices: FloatArray, v_max_mps: float, a_max_mps2: float) -> FloatArray:
    """Return the duration in seconds of each segment (n - 1,) between the vertices (n, 3)."""
    durations_s = []
    for start, end in itertools.pairwise(vertices):
        direct_s = 2.0 * max(norm(end - start), 1e-3) / v_max_mps
        slower = _TIME_FACTOR * v_max_mps / a_max_mps2 * math.exp(-direct_s)
        durations_s.append(direct_s * (1.0 + slower))
    return np.array(durations_s)


def _solve(vertices: FloatArray, durations_s: FloatArray, velocity: FloatArray) -> FloatArray:
    """Return the coefficients (n - 1, 8, 3) of the spline's segments in u = t / duration, 0..1."""
    matrix, right = _equations(vertices, durations_s, velocity)
    _eliminate(matrix, right)
    return right.reshape(len(durations_s), _TERMS, 3)


@compiled
def _equations(
    vertices: FloatArray, durations_s: FloatArray, velocity: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the matrix (m, m) and right-hand side (m, 3) of the equations for the coefficients."""
    segments = len(durations_s)
    size = _TERMS * segments
    matrix, right = np.zeros((size, size)), np.zeros((size, 3))
    # factors[k, m]: factor of u^(m - k) in the k-th derivative of u^m
    factors = np.ones((_TERMS - 1, _TERMS))
    for k in range(1, _TERMS - 1):
        for m in range(_TERMS):
            factors[k, m] = factors[k - 1, m] * (m - k + 1)
    for row, k in enumerate((1, 4, 5)):
        matrix[row, k] = 1.0
        matrix[size - 3 + row, size - _TERMS :] = factors[k]
    right[0] = velocity * durations_s[0]
    for i in range(segments):
        row, column = 3 + _TERMS * i, _TERMS * i
        matrix[row, column] = 1.0
        right[row] = vertices[i]
        matrix[row + 1, column : column + _TERMS] = 1.0
        right[row + 1] = vertices[i + 1]
        if i + 1 == segments:
            break
        ratio = durations_s[i] / durations_s[i + 1]
        scale = 1.0
        for k in range(1, _TERMS - 1):
            scale *= ratio
            matrix[row + 1 + k, column : column + _TERMS] = factors[k]
            matrix[row + 1 + k, column + _TERMS + k] = -factors[k, k] * scale
    return matrix, right


@compiled
def _eliminate(matrix: FloatArray, right: FloatArray) -> None:
    """Replace the right-hand side (m, 3) with the solution of the banded equations.

    This function performs Gaussian elimination with partial pivoting. It avoids BLAS, because the
    last digit of a BLAS solution depends on the processor.
    """
    size = len(matrix)
    for column in range(size):
        end, wide = min(column + _REACH + 1, size), min(column + 2 * _REACH + 1, size)
        pivot = column + np.argmax(np.abs(matrix[column:end, column]))
        for m in range(column, wide):
            matrix[column, m], matrix[pivot, m] = matrix[pivot, m], matrix[column, m]
        for axis in range(3):
            right[column, axis], right[pivot, axis] = right[pivot, axis], right[column, axis]
        for row in range(column + 1, end):
            share = matrix[row, column] / matrix[column, column]
            if share != 0.0:
                for m in range(column, wide):
                    matrix[row, m] -= share * matrix[column, m]
                for axis in range(3):
                    right[row, axis] -= share * right[column, axis]
    for row in range(size - 1, -1, -1):
        for axis in range(3):
            for m in range(row + 1, min(row + 2 * _REACH + 1, size)):
                right[row, axis] -= matrix[row, m] * right[m, axis]
            right[row, axis] /= matrix[row, row]


def _evaluate(
    spline: FloatArray, durations_s: FloatArray, times_s: FloatArray, order: int
) -> FloatArray:
    """Return the `order`-th derivative (k, 3) of the curve at the times (k,). 0 is the position."""
    ends_s = np.cumsum(durations_s)
    index = np.minimum(np.searchsorted(ends_s, times_s, side="right"), len(ends_s) - 1)
    lengths_s = durations_s[index][:, None]
    u = (times_s[:, None] - (ends_s[index] - durations_s[index])[:, None]) / lengths_s
    value = np.zeros((len(times_s), 3))
    for m in range(_TERMS - 1, order - 1, -1):
        value = value * u + math.perm(m, order) * spline[index, m]
    for _ in range(order):
        value = value / lengths_s
    return value


def _first_blocked(
    spline: FloatArray, durations_s: FloatArray, is_free: Callable[[FloatArray], bool]
) -> int | None:
    """Return the index of the first segment that is not free, or None if all are free."""
    for segment, duration_s in enumerate(durations_s.tolist()):
        within_s = np.append(np.arange(0.0, duration_s, _CHECK_STEP_S), duration_s)
        alone = spline[segment : segment + 1], durations_s[segment : segment + 1]
        if not is_free(_evaluate(*alone, within_s, 0)):
            return segment
    return None
