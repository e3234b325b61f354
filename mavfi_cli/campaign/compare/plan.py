"""The missions of a comparison: the same ones on each platform, as a campaign's specification."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mavfi_cli.campaign.keep import Keep
from mavfi_cli.campaign.specification.spec import Setting, Spec
from mavfi_cli.core.config import require_distinct
from mavfi_cli.core.errors import ConfigError
from mavfi_cli.core.types import Stage
from mavfi_cli.mission.stack import DEFAULT

NAME = "compare"
NONE = "none"  # no detector: faults without protection are what detectors are held against
GOLDEN, FAULTY = "golden", "FI"  # settings, named as in the presets
_SHORT = {"gad": "G", "aad": "A"}  # of detectors, in the names of settings
STAGES = tuple(stage.value for stage in Stage)
MOST = 100_000  # missions


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparePlan:
    """What is compared. As it stands: the paper's Fig. 16, mission for mission the preset fig16.

    Attributes:
        platforms: names or files; the others are held against the first.
        inject: stages, states or groups that a fault strikes, one a flight; empty flies golden
            missions only.
        detectors: names; `none` may be among them or not, it is always flown.
        missions: of each platform and setting, and of each target of `inject`.
        first_seed: of the missions; seeds count up from here.
        seed: root of the faults' seeds.
        field: bit field that is struck; None draws any bit.
        stack: of all missions; a name, a file or a variant.

    Raises:
        ConfigError: nothing to fly, or something is named twice.
    """

    platforms: tuple[str, ...] = ("x86", "tx2")
    world: str = "sparse"
    inject: tuple[str, ...] = STAGES
    detectors: tuple[str, ...] = (NONE, "gad", "aad")
    missions: int = 100
    first_seed: int = 1
    seed: int = 1
    field: str | None = None
    stack: str = DEFAULT

    def __post_init__(self) -> None:
        for key, names in (("platform", self.platforms), ("detector", self.detectors)):
            if not names:
                raise ConfigError("name at least one", key=key)
        if self.missions < 1:
            raise ConfigError(f"must be at least 1, got {self.missions}", key="missions")
        if self.missions > MOST:
            raise ConfigError(f"must be at most {MOST}, got {self.missions}", key="missions")
        for key, least in (("first_seed", 0), ("seed", 0)):
            if getattr(self, key) < least:
                raise ConfigError(f"must not be negative, got {getattr(self, key)}", key=key)
        if self.field is not None and not self.inject:
            raise ConfigError(f"{self.field}: there is no fault", key="field")
        for key, names in (
            ("platform", self.platforms),
            ("inject", self.inject),
            ("detector", self.detectors),
        ):
            require_distinct(names, key)
        require_distinct([_place(name) for name in self.platforms], "platform")

    @property
    def protectors(self) -> tuple[str, ...]:
        """The detectors without `none`."""
        return tuple(name for name in self.detectors if name != NONE)

    @property
    def settings(self) -> tuple[str, ...]:
        """Golden, `none`, and the detectors: what is flown on each platform."""
        return (GOLDEN, NONE, *self.protectors) if self.inject else (GOLDEN,)

    def spec(self) -> Spec:
        """The campaign."""
        axis = "stage" if set(self.inject) <= set(STAGES) else "site"
        faults: dict[str, tuple[Any, ...]] = {axis: self.inject}
        if self.field is not None:
            faults["field"] = (self.field,)
        protected = [
            Setting(name=_setting_name(name), axes={**faults, "detector": (name,)})
            for name in self.protectors
        ]
        faulty = [Setting(name=FAULTY, axes=faults), *protected] if self.inject else []
        return Spec(
            name=NAME,
            about="The same missions on several computers",
            seed=self.seed,
            first_seed=self.first_seed,
            repetitions=self.missions,
            keep=Keep.NONE,
            fixed={} if self.stack == DEFAULT else {"stack": self.stack},
            axes={"world": (self.world,), "platform": self.platforms},
            settings=(Setting(name=GOLDEN), *faulty),
        )


def _place(name: str) -> str:
    """The same of two spellings of one file."""
    return str(Path(name).resolve()) if name.endswith(".toml") else name


def _setting_name(detector: str) -> str:
    return f"D&R({_SHORT.get(detector, detector)})"


def titles(platforms: Sequence[str]) -> dict[str, str]:
    """What platforms are called in tables and pictures: a file by its stem, where that tells."""
    short = [name.removesuffix(".toml").rpartition("/")[2] for name in platforms]
    return {
        name: stem if short.count(stem) == 1 else name
        for name, stem in zip(platforms, short, strict=True)
    }
