"""The commands' machine-readable outputs are what they were: a guard for every redesign.

Each hash stands for all that a command reports, without what tells of time, host, versions and
paths. A change that means to alter a record renews the hash and says why.
"""

import csv
import hashlib
import io
import json

import pytest
from missions import LAWN, SHORT_WAY

# Fields of reports that depend on the host, on the clock or on the code's own files; a struck
# register may hold an address, and where the stack begins depends on the length of paths. A
# corrupted pointer reads whatever lies there, which moves with every change of a docstring, so the
# size of a silent corruption and the kind of a crash are not compared.
_PASSING = {
    *(
        "attempts",
        "build_ids",
        "check_share",
        "cpu_s",
        "crashes",
        "host",
        "injections_per_core_hour",
        "path",
        "prepare_s",
    ),
    *("sdc_relative", "sources", "struck_after_hex", "struck_before_hex", "timeline"),
    *("versions", "wall_s"),
}
CAMPAIGN = f"""
name = "hashed"
repetitions = 1
keep = "none"
{SHORT_WAY}world = "farm"
time_limit_s = 40.0
[factors]
stack = ["mavbench", "hardened"]
[[setting]]
name = "golden"
[[setting]]
name = "FI"
site = "waypoint_position"
together = true
field = "exponent"
[[setting]]
name = "FI"
level = "instruction"
stage = "control"
[[setting]]
name = "D&R(A)"
site = "waypoint_position"
together = true
field = "exponent"
detector = "aad"
any_stack = true
"""


def lasting(value):
    """The report without the fields that differ from run to run."""
    if isinstance(value, dict):
        return {key: lasting(item) for key, item in value.items() if key not in _PASSING}
    if isinstance(value, list):
        return [lasting(item) for item in value]
    return value


def digest(value):
    return hashlib.sha256(json.dumps(lasting(value), sort_keys=True).encode()).hexdigest()[:16]


@pytest.fixture
def report(mavfi, tmp_path):
    """Run a command in an empty folder; what it prints, as JSON or as rows of CSV."""
    (tmp_path / "hashed.toml").write_text(CAMPAIGN)
    (tmp_path / "lawn.toml").write_text(LAWN)

    def run(arguments):
        done = mavfi(*arguments, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        if done.stdout.startswith(("{", "[")):
            return json.loads(done.stdout)
        return list(csv.DictReader(io.StringIO(done.stdout)))

    return run


# `compare`, `evaluate` and `vpm --fly` were renewed when they flew over a lawn instead of a farm.
COMMANDS = {
    # Renewed when an export got the costs of detection and recovery, and when kernels became code
    # of x86-64-v3 on every processor, so that a fault in an instruction strikes the same one, and
    # when `struck_bits` became a list.
    # Renewed when summaries got `sampling`, and exports `stratum` and `weight`; all else is equal.
    # Renewed when summaries got `unpaired_faults` and `unpaired_protection`, and failures `golden`,
    # which are empty without a user's companion; all else is equal.
    # Renewed when its missions got a time limit of 40 s, which one of them reaches.
    # Renewed when exports got `alarm_count`; all else is equal.
    # Renewed when McNemar's tests got `difference`; all else is equal.
    "campaign": (
        "29c35d446af9959f",
        ["campaign", "run", "hashed.toml", "--quiet", "--out", "c", "--json"],
        ["campaign", "status", "c", "--quality", "--failures", "--json"],
        ["campaign", "export", "c", "-"],
    ),
    # Renewed when the paper's presets got fixed worlds: only `fixed_world` differs.
    "plan": ("440137ac25e911f4", ["campaign", "plan", "fig7", "--json"]),
    # Renewed when its inputs_sha256 became that of an .npz file, because no pickle is on the disk.
    # Renewed when operands became the bits that are read or written, and when the settings got the
    # memory of a run, and with the code of x86-64-v3.
    # Renewed when the summary got the null runs; all else is equal.
    # Renewed when control's parameters, which its inputs contain, got `slice_period_s`: only
    # `inputs_sha256` differs.
    "kernels": ("42f19572d5433429", ["kernels", "--kernel", "control", "--runs", "12", "--json"]),
    "compare": (
        "c22443e05096932c",
        [
            *("compare", "--platform", "x86", "--platform", "tx2", "--world", "lawn.toml"),
            *("--inject", "waypoint_position", "--field", "mantissa", "--detector", "none,gad"),
            *("--missions", "1", "--quiet", "--json"),
        ],
    ),
    # Renewed when harm began at 10 % and `otherwise` and `golden` went (schema 2).
    # Renewed when McNemar's tests got `difference`; all else is equal.
    "evaluate": (
        "15ba5068bdbd7d8d",
        [
            *("detect", "evaluate", "--world", "lawn.toml", "--detector", "none,gad"),
            *("--flights", "1", "--golden-flights", "1", "--field", "exponent"),
            *("--quiet", "--json"),
        ],
    ),
    # Renewed when its curve got its throughputs from libm: those of numpy depend on the processor.
    "vpm": ("42b0c90aea6f35bb", ["vpm", "--vehicle", "spark", "--json"]),
    "vpm --fly": (
        "8345305146863b05",
        [
            *("vpm", "--vehicle", "spark", "--fly", "--world", "lawn.toml", "--missions", "1"),
            *("--quiet", "--csv"),
        ],
    ),
    "platforms": ("74ae6a5804b06c25", ["platforms", "--json"]),
    # Renewed when stacks got smoother, slice_period_s, restores_counters and standby.
    "stacks": ("7bd4f9e1afab2d76", ["stacks", "mavbench", "--json"]),
    "states": ("a82ad9744e330395", ["states", "--json"]),
}


FLYING = ("campaign", "compare", "evaluate", "vpm --fly", "kernels")


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] * (name in FLYING)) for name in COMMANDS],
)
def test_the_report_is_what_it_was(name, report):
    expected, *commands = COMMANDS[name]
    assert digest([report(arguments) for arguments in commands]) == expected
