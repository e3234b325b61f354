"""Geometry of the camera: optics, mount and pose."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.errors import ConfigError
from mavfi_cli.core.frames import flu_enu_from_frd_ned, rotation_matrix

Vector = NDArray[np.float64]

MAX_SIDE_PX = 2048


@dataclass(frozen=True, slots=True, kw_only=True)
class Optics:
    """A pinhole camera with square pixels that looks forward.

    Raises:
        ConfigError: The image size or field of view is invalid.
    """

    columns: int = 64
    rows: int = 48
    hfov_rad: float = math.pi / 2.0
    mount_offset_flu_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not (1 <= self.columns <= MAX_SIDE_PX and 1 <= self.rows <= MAX_SIDE_PX):
            size = f"{self.columns}x{self.rows}"
            raise ConfigError(f"camera size {size}: each side must be 1 to {MAX_SIDE_PX} pixels")
        if not 0.01 <= self.hfov_rad <= 3.1:
            raise ConfigError(f"camera field of view {self.hfov_rad:g} rad: must be 0.01 to 3.1")

    @property
    def focal_px(self) -> float:
        """Focal length, pixels."""
        return self.columns / 2.0 / math.tan(self.hfov_rad / 2.0)

    @property
    def vfov_rad(self) -> float:
        """Vertical field of view, rad."""
        return 2.0 * math.atan(self.rows / 2.0 / self.focal_px)


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraPose:
    """Pose of the camera at one stamp."""

    stamp_s: float
    position_enu_m: Vector  # (3,) optical centre
    quaternion_flu_enu: Vector  # (4,) w x y z

    @property
    def quaternion_frd_ned(self) -> list[float]:
        """Attitude in MAVLink's frames, w x y z."""
        values: list[float] = flu_enu_from_frd_ned(self.quaternion_flu_enu).tolist()
        return values


def camera_pose(
    optics: Optics, stamp_s: float, position_enu_m: Vector, quaternion_flu_enu: Vector
) -> CameraPose:
    """Return the camera's pose on a vehicle at a position (3,) with an attitude (4,)."""
    offset = rotation_matrix(quaternion_flu_enu) @ np.array(optics.mount_offset_flu_m)
    return CameraPose(
        stamp_s=stamp_s,
        position_enu_m=position_enu_m + offset,
        quaternion_flu_enu=quaternion_flu_enu,
    )
