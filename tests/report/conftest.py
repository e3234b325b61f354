"""A whole comparison that nobody flew."""

from flown_twice import whole  # noqa: F401
