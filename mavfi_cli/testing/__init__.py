"""Contract suites for plug-ins, for pytest. A plug-in's author subclasses one in a test module.

from mavfi_cli.testing import PlannerContract

class TestMine(PlannerContract):
    planner = "mine"
"""

import pytest

# Before the import: else a failed assertion is not explained.
pytest.register_assert_rewrite("mavfi_cli.testing.suites")

from mavfi_cli.testing.suites import (  # noqa: E402
    DetectorContract,
    PlannerContract,
    StreamTransportContract,
    TransportContract,
)

__all__ = ["DetectorContract", "PlannerContract", "StreamTransportContract", "TransportContract"]
