"""Tests mirror the package: a folder of tests is a room of it, or one of a few that span rooms."""

from itertools import pairwise
from pathlib import Path

import pytest

TESTS = Path(__file__).parent
SPANNING = {
    "clients": "real third-party clients against `mavfi sitl`",
    "contract": "the suites of mavfi_cli.testing on what is shipped",
    "docs": "what the documents say",
    "examples": "the programs of examples/",
    "laws": "properties that hold for any input, over several rooms",
}
FOLDERS = sorted({path.parent.relative_to(TESTS) for path in TESTS.glob("*/**/test_*.py")})


@pytest.mark.parametrize("folder", FOLDERS, ids=str)
def test_a_folder_of_tests_is_a_room(folder):
    places = (TESTS.parent / "mavfi_cli" / folder, TESTS.parent / folder)
    assert str(folder) in SPANNING or any((place / "__init__.py").is_file() for place in places)


def test_no_two_files_of_tests_have_one_name():
    """pytest imports each by its file's name, and refuses the second."""
    names = sorted(path.name for path in TESTS.rglob("test_*.py"))
    assert [name for name, after in pairwise(names) if name == after] == []
