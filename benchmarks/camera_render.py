"""Measures the time to render a depth frame, and to encode its messages, in the world `dense`.

Run: python benchmarks/camera_render.py
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from functools import partial

import numpy as np

from mavfi_cli.core.frames import quaternion_from_euler
from mavfi_cli.link.codec import Codec, dialect
from sitl.camera.component import Camera
from sitl.camera.depth import render_depth
from sitl.world import load_world

POSES = {
    "start, at 5 m": ((0.0, 0.0, 5.0), 0.93),
    "between towers": ((20.0, 20.0, 5.0), 0.0),
    "near the goal": ((25.0, 33.0, 5.0), -2.2),
    "on the ground": ((0.0, 0.0, 0.15), 0.93),
    "inside a margin": ((-18.0, -18.0, 5.0), 0.8),
}
SIZES = ((64, 48), (256, 144), (512, 288))


def milliseconds(action: Callable[[], object], repeats: int = 200) -> float:
    """Return the median time of one call, in milliseconds."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        action()
        times.append(time.perf_counter() - start)
    return statistics.median(times) * 1e3


def main() -> None:
    """Print one line per pose, and one line for rendering and encoding a whole frame."""
    boxes = load_world("dense", seed=1).boxes_enu_m
    print(f"{len(boxes)} boxes" + "".join(f"{f'{c}x{r}':>12}" for c, r in SIZES))
    for name, (position, yaw) in POSES.items():
        quaternion = quaternion_from_euler(0.0, 0.05, yaw)
        at = np.array(position)
        row = [
            milliseconds(partial(render_depth, boxes, at, quaternion, c, r, math.pi / 2.0))
            for c, r in SIZES
        ]
        print(f"{name:<16}" + "".join(f"{value:9.3f} ms" for value in row))
    camera, codec = Camera(boxes, rate_hz=50.0), Codec(1, 100)
    ask = dialect.MAVLink_command_long_message(1, 100, 2000, 0, 0, 0.02, 0, 0, 0, 0, 0)
    camera.handle(codec.decode(codec.encode(ask))[0])
    stamps = iter(range(10**6))
    level = np.array([1.0, 0.0, 0.0, 0.0])

    def frame() -> None:
        """Render one image, pack it into messages and encode them."""
        for message in camera.poll(next(stamps) * 0.02, np.array([0.0, 0.0, 5.0]), level):
            codec.encode(message)

    print(f"64x48 rendered, packed and encoded: {milliseconds(frame):.3f} ms")


if __name__ == "__main__":
    main()
