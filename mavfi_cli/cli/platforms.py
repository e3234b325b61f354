"""`mavfi platforms`: the compute platforms, and the source of their latencies."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import click

_P95 = 1.6449  # standard normal: 90 % lie within


@click.command()
@click.argument("names", nargs=-1, metavar="[NAME|FILE]...")
@click.option("--json", "as_json", is_flag=True, help="Print everything as JSON.")
def platforms(names: tuple[str, ...], as_json: bool) -> None:
    """List the compute platforms, or show the named ones kernel by kernel."""
    from mavfi_cli.spec.platform import PLATFORMS, load_platform

    profiles = [load_platform(name) for name in names or PLATFORMS.names]
    if as_json:
        click.echo(json.dumps([asdict(profile) for profile in profiles], indent=2))
    elif names:
        click.echo("\n\n".join(_explained(profile) for profile in profiles))
    else:
        for profile in profiles:
            click.echo(_line(profile))
        click.echo(
            "measured:FACTOR  this host's own kernel times while it flies, times FACTOR; for "
            "`mavfi fly --realtime` only"
        )
        click.echo(
            "\n`mavfi platforms NAME` shows every kernel; "
            "docs/how-to/platform.md says how to add one."
        )


def _all_s(profile: Any) -> float:
    return float(sum(latency.latency_s for latency in profile.kernels.values()))


def _line(profile: Any) -> str:
    return (
        f"{profile.name:<12} {profile.cores:>3} cores {profile.power_w:>6.1f} W  "
        f"board {1000 * profile.mass_kg:>3.0f} g  all kernels {_all_s(profile):>6.3f} s  "
        f"{profile.description}"
    )


def _explained(profile: Any) -> str:
    if profile.measured_factor is not None:
        return _measured(profile)
    based = f"; latencies from {profile.base}" if profile.base else ""
    where = "carried" if profile.carried else "stays on the ground"
    lines = [
        f"{_title(profile)}; {where}{based}",
        *_hardware(profile),
        "",
        f"{'kernel':<16} {'median':>10}  {'5 % to 95 %':>22}  source",
    ]
    for name, latency in profile.kernels.items():
        factor = math.exp(_P95 * latency.spread)
        low, high = (1000 * latency.latency_s * f for f in (1.0 / factor, factor))
        lines.append(
            f"{name:<16} {1000 * latency.latency_s:>7.2f} ms  {low:>8.2f} to {high:>8.2f} ms  "
            f"{latency.source or 'not given'}"
        )
    lines.append(f"{'all of them':<16} {1000 * _all_s(profile):>7.2f} ms")
    if "spread" in profile.sources:
        lines.append(f"{'their spread':<53} {profile.sources['spread']}")
    return "\n".join(lines)


def _title(profile: Any) -> str:
    return f"{profile.name}: {profile.description}" if profile.description else profile.name


def _hardware(profile: Any) -> Iterator[str]:
    """One line per number of the computer, with its source; masses only if it is carried."""
    rows = [("cores", f"{profile.cores}", "cores"), ("power", f"{profile.power_w:g} W", "power_w")]
    if profile.carried:
        rows += [
            ("board", f"{1000 * profile.mass_kg:g} g", "mass_kg"),
            ("heat sink", f"{1000 * profile.heatsink_kgpw:g} g/W", "heatsink_kgpw"),
        ]
    for title, value, key in rows:
        yield f"{title:<16} {value:>10}  {profile.sources.get(key, 'not given')}"


def _measured(profile: Any) -> str:
    return "\n".join(
        [
            f"{profile.name}: {profile.description}",
            f"{profile.cores} cores, stays on the ground",
            f"Every invocation of {', '.join(profile.kernels)} is",
            f"measured on this host, and its output takes effect {profile.measured_factor:g} times "
            "as much later.",
            "result.json has the medians. Such a flight does not repeat: `mavfi fly --realtime`",
            "only, neither in campaigns nor with `mavfi replay`.",
        ]
    )
