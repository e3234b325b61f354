"""Fixtures of the tests of the paper."""

import os

import pytest

from mavfi_cli.paper import flying


@pytest.fixture(scope="module")
def no_vehicle():
    """Let nothing start a vehicle, and let the workers find the task that flies nothing."""
    folder = os.path.join(os.path.dirname(__file__), os.pardir, "campaigns")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flying, "check_kinds", lambda missions: None)
        patch.syspath_prepend(folder)
        patch.setenv("PYTHONPATH", folder)
        yield
