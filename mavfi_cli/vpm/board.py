"""Boards: the computer's mass and power, one TOML file a board."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from mavfi_cli.core.config import load_shipped
from mavfi_cli.spec.platform import HARDWARE, PlatformProfile, check_hardware

_FOLDER = Path(__file__).parent / "boards"


@dataclass(frozen=True, slots=True, kw_only=True)
class Board:
    """One copy of the computer that the vehicle carries."""

    name: str
    mass_kg: float  # without the heat sink
    power_w: float  # thermal design power
    heatsink_kgpw: float  # mass of the heat sink for each watt of power_w
    description: str = ""
    sources: dict[str, str] = field(default_factory=dict)  # key -> source of its number

    def __post_init__(self) -> None:
        check_hardware(self)

    @property
    def total_kg(self) -> float:
        """Mass of a board and its heat sink, kg."""
        return self.mass_kg + self.heatsink_kgpw * self.power_w

    @classmethod
    def of_platform(cls, platform: PlatformProfile) -> Board:
        """The board of a platform; a platform on the ground has neither mass nor power."""
        told = f"platform {platform.name}"
        sources = {key: f"{told}: {platform.sources.get(key, 'not given')}" for key in HARDWARE}
        if not platform.carried:
            sources = dict.fromkeys(HARDWARE, f"{told} stays on the ground")
        return cls(
            name=platform.name,
            description=platform.description,
            sources=sources,
            **{key: getattr(platform, key) if platform.carried else 0.0 for key in HARDWARE},
        )


def load_board(name_or_path: str) -> Board:
    """A shipped board by name, or a user's own by the path of its TOML file.

    Raises:
        UnknownName: no shipped board has this name, and it is not a path to a TOML file.
        ConfigError: the file cannot be used.
    """
    return load_shipped("board", name_or_path, _FOLDER, Board)
