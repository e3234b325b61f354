"""Writes a resolved specification: the campaign.toml in a campaign's folder."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from mavfi_cli.campaign.specification.spec import Axes, Spec


def to_toml(spec: Spec) -> str:
    """Write TOML from which `parse_spec` makes an equal specification."""
    lines = _pairs(
        {
            "name": spec.name,
            "about": spec.about,
            "seed": spec.seed,
            "first_seed": spec.first_seed,
            "repetitions": spec.repetitions,
            "keep": spec.keep.value,
        }
    )
    lines += _table("[mission]", spec.fixed)
    lines += _table("[factors]", _lists(spec.axes))
    for setting in spec.settings:
        own: dict[str, Any] = {"name": setting.name} if setting.name else {}
        if setting.repetitions is not None:
            own["repetitions"] = setting.repetitions
        lines += ["", "[[setting]]", *_pairs({**own, **_lists(setting.axes)})]
    if spec.stop is not None:
        lines += _table("[stop]", asdict(spec.stop))
    if spec.fixed_world is not None:
        rule = asdict(spec.fixed_world)
        inner = {key: rule.pop(key) for key in ("world_seed", "flown")}
        lines += _table("[fixed_world]", rule)
        for key, values in inner.items():
            lines += _table(f"[fixed_world.{key}]", _quoted(values))
    return "\n".join(lines) + "\n"


def _table(head: str, values: Mapping[str, Any]) -> list[str]:
    return ["", head, *_pairs(values)] if values else []


def _quoted(values: Mapping[str, Any]) -> dict[str, Any]:
    """Quote the keys, because names of worlds may not be bare keys of TOML."""
    return {json.dumps(key, ensure_ascii=False): value for key, value in values.items()}


def _pairs(values: Mapping[str, Any]) -> list[str]:
    # Strings, numbers, booleans and arrays are written in TOML as in JSON.
    return [f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in values.items()]


def _lists(axes: Axes) -> dict[str, Any]:
    """Each factor as the list of its values; a list-valued factor as a list of lists."""
    return {name: list(values) for name, values in axes.items()}
