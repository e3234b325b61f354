"""Every registered detector passes the contract suite."""

import pytest

from mavfi_cli.core.errors import UnknownName
from mavfi_cli.detect import base
from mavfi_cli.testing import DetectorContract


class TestDetectors(DetectorContract):
    @pytest.fixture(params=base.PLUG_INS.names)
    def name(self, request):
        return request.param


def test_ours_are_there():
    assert {"gad", "aad", "range", "l2"} <= set(base.PLUG_INS.names)


def test_an_unknown_name_names_the_nearest():
    with pytest.raises(UnknownName, match="did you mean 'gad'"):
        base.find_detector("gaad")
