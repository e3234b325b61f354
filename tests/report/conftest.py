"""A whole comparison that nobody flew, and the page of committed campaigns in a browser."""

import pytest
from browser import Browser
from committed import everything
from made_flights import whole  # noqa: F401

from mavfi_cli.report.page import render


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
