"""Test suites that check whether a plug-in keeps its contract. Subclass one in a test module.

pytest then runs its tests:

from mavfi_cli.testing import PlannerContract

class TestMine(PlannerContract):
    planner = "mine"
"""

import pytest

# Before the import, so that pytest explains failed assertions.
pytest.register_assert_rewrite("mavfi_cli.testing.suites")

from mavfi_cli.testing.suites import DetectorContract, PlannerContract  # noqa: E402

__all__ = ["DetectorContract", "PlannerContract"]
