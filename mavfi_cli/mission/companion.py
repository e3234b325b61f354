"""The companion computer: the pipeline's nodes wired together, one control tick at a time.

    depth frame -> point cloud -> OctoMap -> collision check -> pilot -> tracking -> setpoint
                                     |                            |  ^
                                     +------------> planner <-----+--+

Every arrow out of a kernel passes through one place here (`_publish_...`), which is where a
fault is injected and a detector looks.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from mavfi_cli.autonomy import collision, occupancy, planning, point_cloud, tracking
from mavfi_cli.autonomy.pilot import Directive, Mode, Pilot, PilotParams, PlanFailure, PlanRequest
from mavfi_cli.core.seeds import Stream, derive
from mavfi_cli.core.types import (
    CollisionReport,
    Command,
    DepthFrame,
    FloatArray,
    PointCloud,
    Trajectory,
    VehicleState,
)
from mavfi_cli.mission.config import MissionConfig
from mavfi_cli.mission.events import EventLog
from mavfi_cli.mission.executor import Executor
from mavfi_cli.mission.platform import LatencyModel, PlatformProfile

SAME_TICK_S = 0.004  # a command this quick goes out in the tick that it was computed in
