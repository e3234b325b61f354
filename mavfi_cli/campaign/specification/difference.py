"""Differences between two specifications that change which missions are flown."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from mavfi_cli.campaign.specification.spec import Axes, Setting, Spec

_Choices = Mapping[str, Sequence[Any]]


def differences(stored: Spec, asked: Spec, repetitions: str = "repetitions") -> list[str]:
    """Return a phrase for each factor or number that differs; names and stops do not count.

    Args:
        repetitions: the word for repetitions.
    """
    found = list(_phrases(_choices(stored, repetitions), _choices(asked, repetitions)))
    return found or list(_between_settings(stored, asked))


def _phrases(there: _Choices, here: _Choices) -> Iterator[str]:
    for key in dict.fromkeys((*there, *here)):
        old, new = there.get(key, ()), here.get(key, ())
        if old == new:
            continue
        gone = [value for value in old if value not in new]
        added = [value for value in new if value not in old]
        if len(gone) < len(old) and (gone or added):  # they share values: name only the others
            parts = [f"{_told(gone)} only there"] if gone else []
            parts += [f"{_told(added)} only here"] if added else []
            yield f"{key} {', '.join(parts)}"
        else:
            yield f"{key} {_told(old)} there, {_told(new)} here"


def _choices(spec: Spec, repetitions: str) -> _Choices:
    """Factors with all their values, and the numbers."""
    found: dict[str, list[Any]] = {}
    for axes in (spec.axes, *(setting.axes for setting in spec.settings)):
        for name, values in axes.items():
            known = found.setdefault(name, [])
            known += [value for value in values if value not in known]
    found |= {f"mission.{name}": [value] for name, value in spec.fixed.items()}
    if spec.fixed_world is not None:
        found["rule of fixed worlds"] = [spec.fixed_world.rule()]
        seeds = spec.fixed_world.world_seed.items()
        found["fixed worlds"] = [f"{world} {seed}" for world, seed in seeds]
    return {
        **found,
        repetitions: [spec.repetitions],
        "first seed": [spec.first_seed],
        "fault seed": [spec.seed],
        "settings": [setting.name for setting in spec.settings],
    }


def _between_settings(stored: Spec, asked: Spec) -> Iterator[str]:
    """Phrases for equal values in other settings."""
    for there, here in zip(stored.settings, asked.settings, strict=True):
        name = f" of setting {here.name}" if here.name else ""
        for phrase in _phrases(_of_setting(there), _of_setting(here)):
            factor, _, rest = phrase.partition(" ")
            yield f"{factor}{name} {rest}"
    yield from _phrases(_listed(stored.axes), _listed(asked.axes))


def _of_setting(setting: Setting) -> _Choices:
    own = () if setting.repetitions is None else (setting.repetitions,)
    return {**_listed(setting.axes), "repetitions": own}


def _listed(axes: Axes) -> _Choices:
    return {name: list(values) for name, values in axes.items()}


def _told(values: Sequence[Any]) -> str:
    return ", ".join(map(str, values)) if values else "none"
