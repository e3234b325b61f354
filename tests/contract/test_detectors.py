"""Every registered detector passes the contract suite."""

import pytest

from mavfi_cli.core.errors import UnknownName
from mavfi_cli.detect import base
from mavfi_cli.testing import DetectorContract


class TestDetectors(DetectorContract):
    @pytest.fixture(params=base.detector_names())
    def name(self, request):
        return request.param


def test_ours_are_there():
    assert {"gad", "aad", "range", "l2"} <= set(base.detector_names())


def test_an_unknown_name_names_the_nearest():
    with pytest.raises(UnknownName, match="did you mean 'gad'"):
        base.find_detector("gaad")
