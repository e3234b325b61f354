"""Ledgers and comparisons that nobody flew."""

import pytest
from made_flights import Book, whole  # noqa: F401


@pytest.fixture
def book(tmp_path):
    written = Book(tmp_path / "campaign")
    yield written
    written.ledger.close()
