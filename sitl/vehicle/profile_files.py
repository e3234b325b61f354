"""Loads vehicle profiles from TOML files: shipped ones, or a user's own."""

from __future__ import annotations

from pathlib import Path

from mavfi_cli.core.config import load_toml, read_toml, structure
from mavfi_cli.core.errors import ConfigError, UnknownName
from sitl.vehicle.profile import VehicleProfile
from sitl.vehicle.stand_in import StandIn

_PROFILES = Path(__file__).parent / "profiles"


def profile_names() -> list[str]:
    """Return the names of the shipped profiles."""
    return sorted(path.stem for path in _PROFILES.glob("*.toml"))


def load_profile(name_or_path: str) -> VehicleProfile:
    """Load a shipped profile by name, or any profile by the path of its TOML file.

    A file with a `base` scales a shipped profile; see `sitl.vehicle.stand_in`.

    Raises:
        UnknownName: It is neither a shipped profile nor a TOML path.
        ConfigError: The file cannot be read, or its vehicle cannot fly.
    """
    if name_or_path in profile_names():
        return load_toml(_PROFILES / f"{name_or_path}.toml", VehicleProfile)
    if name_or_path.endswith(".toml") or "/" in name_or_path:
        return _load_file(Path(name_or_path))
    raise UnknownName("vehicle", name_or_path, profile_names())


def _load_file(path: Path) -> VehicleProfile:
    data, text = read_toml(path)
    if "base" not in data:
        return structure(data, VehicleProfile, path=path, text=text)
    stand_in = structure(data, StandIn, path=path, text=text)
    if stand_in.base not in profile_names():
        error = UnknownName("vehicle", stand_in.base, profile_names())
        raise ConfigError(str(error), path=path, key="base")
    try:
        return stand_in.profile(load_profile(stand_in.base))
    except (ConfigError, ValueError) as problem:
        raise ConfigError(str(problem), path=path) from None
