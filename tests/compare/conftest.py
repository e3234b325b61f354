"""A whole comparison that nobody flew."""

import pytest
from flown_twice import PLAN, made_up

from mavfi_cli.campaign.compare.figures import figures
from mavfi_cli.campaign.compare.fly import plan_told


def lane(*spans):
    return [list(span) for span in spans]


def panel(platform, factor):
    """A frame's way through kernels that take so many times as long as on x86."""
    octomap, check = 0.3 * factor, 0.02 * factor
    answer = round(octomap + check + 0.04, 2)
    chain = {
        "point_cloud": [0.0, 0.002],
        "octomap": [0.02, 0.02 + octomap],
        "collision_check": [0.02 + octomap, 0.02 + octomap + check],
        "control": [answer, answer + 0.0005],
        "planner": [answer, answer + 0.08 * factor],
    }
    return {
        "platform": platform,
        "frame_stamp_s": 12.0,
        "response_s": answer,
        "answer": "stops before an obstacle",
        "plan_setpoint_s": answer + 0.1 * factor,
        "shown_s": [-0.05, 2.5],
        "chain_s": chain,
        "lanes_s": {name: lane(span) for name, span in chain.items()},
        "setpoints_s": [0.02 * tick for tick in range(125)],
    }


@pytest.fixture(scope="session")
def whole():
    """All that compare.json holds, of made-up flights; do not change it."""
    return {
        "schema": 1,
        "plan": plan_told(PLAN),
        "versions": {},
        "errors": [],
        **figures(PLAN, made_up()),
        "timeline": {"seed": 4, "platforms": [panel("x86", 1.0), panel("tx2", 4.0)]},
    }
