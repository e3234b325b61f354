"""From an SDC of a kernel to failed missions, and to failures per flight hour."""

from __future__ import annotations

from dataclasses import dataclass

from mavfi_cli.core.errors import ConfigError
from mavfi_cli.stats.shares import Share, rate


@dataclass(frozen=True, slots=True, kw_only=True)
class CrossLayer:
    """Effects of a fault in a kernel on the kernel and on the mission.

    Attributes:
        corruption: share of faults that cause an SDC of the kernel.
        failure: share of faults that fail the mission.
        failure_given_corruption: failure / corruption, with the ends of the failure's interval over
            the corruption's point estimate; None if the estimate would be above 1 (crashes and
            hangs fail missions too) or no output was corrupted.
    """

    corruption: Share
    failure: Share
    failure_given_corruption: tuple[float, float, float] | None


def cross_layer(
    corrupted: int, kernel_faults: int, failed: int, mission_faults: int, confidence: float = 0.95
) -> CrossLayer:
    """The probability that a mission fails, given an SDC of a kernel.

    Both campaigns must sample the same population: the same kernel, level and sampling rule.

    Args:
        corrupted, kernel_faults: SDCs and injected faults of the isolated kernel (`mavfi kernels`).
        failed, mission_faults: failures beyond the golden ones and applied faults of missions.
    """
    corruption = rate(corrupted, kernel_faults, confidence)
    failure = rate(failed, mission_faults, confidence)
    given = None
    if corrupted and failure.share <= corruption.share:
        ends = (failure.share, failure.low, failure.high)
        point, low, high = (min(1.0, each / corruption.share) for each in ends)
        given = point, low, high
    return CrossLayer(corruption=corruption, failure=failure, failure_given_corruption=given)


def failures_per_hour(upsets_per_hour: float, failure: Share) -> tuple[float, float, float]:
    """Failed missions per flight hour at a rate of upsets: point, low, high.

    The extrapolation assumes at most one upset per mission, as harmful as in the campaign.

    Args:
        upsets_per_hour: bit flips that reach the attacked kernels per flight hour.
        failure: failure rate of missions with one fault each.

    Raises:
        ConfigError: the rate is negative.
    """
    if not upsets_per_hour >= 0.0:
        raise ConfigError(f"must not be negative, got {upsets_per_hour:g}", key="upsets_per_hour")
    return (
        upsets_per_hour * failure.share,
        upsets_per_hour * failure.low,
        upsets_per_hour * failure.high,
    )
