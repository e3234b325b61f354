"""The page of committed campaigns, and a browser that opens it."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from browser import Browser
from committed import everything

from mavfi_cli.report.page.render import render


@pytest.fixture(scope="session")
def told():
    """Everything that the page tells."""
    return everything()


@pytest.fixture(scope="session")
def page(told, tmp_path_factory):
    """The page of these campaigns."""
    path = tmp_path_factory.mktemp("page") / "report.html"
    path.write_text(render(told), encoding="utf-8")
    return path


@pytest.fixture(scope="session")
def browser(tmp_path_factory):
    """A headless browser."""
    return Browser(tmp_path_factory.mktemp("browser"))
