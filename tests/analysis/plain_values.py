"""Plain values as objects, so that tests read like sentences."""

from dataclasses import fields
from types import SimpleNamespace

from mavfi_cli.stats.paired import McNemar

KEPT = ("labels", "first", "second", "injected", "outcomes", "recomputations")
TEST = {field.name for field in fields(McNemar)}


class Named(SimpleNamespace):
    """A row; its parts by name or as items."""

    def __getitem__(self, name):
        return getattr(self, name)


def named(value):
    """Rows and their parts by their names; labels, and counts by name, stay as they are."""
    if isinstance(value, list):
        return [named(each) for each in value]
    if not isinstance(value, dict):
        return value
    if set(value) == TEST:
        return McNemar(**value)
    return Named(**{k: each if k in KEPT else named(each) for k, each in value.items()})
