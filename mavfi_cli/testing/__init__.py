"""Contract suites for plug-ins, for pytest. A plug-in's author subclasses one in a test module.

from mavfi_cli.testing import PlannerContract

class TestMine(PlannerContract):
    planner = "mine"
"""

import pytest

for _suite in ("detectors", "planners", "transports"):  # before the imports: else no explanations
    pytest.register_assert_rewrite(f"mavfi_cli.testing.{_suite}")

from mavfi_cli.testing.detectors import DetectorContract  # noqa: E402
from mavfi_cli.testing.planners import PlannerContract  # noqa: E402
from mavfi_cli.testing.transports import StreamTransportContract, TransportContract  # noqa: E402

__all__ = ["DetectorContract", "PlannerContract", "StreamTransportContract", "TransportContract"]
