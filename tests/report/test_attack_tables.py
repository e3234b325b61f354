"""Shares in the summary of attacked programs."""

from types import SimpleNamespace

from mavfi_cli.attack.campaign import Plan
from mavfi_cli.attack.null_runs import NullRuns
from mavfi_cli.report.attacks import summarise


def outcomes(told, *, windows=None):
    """The shares of runs with these outcomes, of which each hit one of some sampled windows."""
    records = [
        {
            "run": run, "outcome": outcome, "signal": 11, "not_injected_reason": "",
            "activation": {"activation": "read"},
        }
        for run, outcome in enumerate(told)
    ]  # fmt: skip
    profile = None
    if windows:
        profile = SimpleNamespace(
            window_of=lambda entry: (0, entry["run"] % windows), sampled={0: windows}, executed=1,
            complete=False, windows="", counted=None, not_reached=0.0, cost_s=0.0,
        )  # fmt: skip
    golden = SimpleNamespace(exit_code=0, cpu_s=0.0, wall_s=0.0)
    runs = SimpleNamespace(
        target=None, records=records, context={}, golden=golden, profile=profile, wall_s=0.0,
        profiles=[profile], input_of=lambda _run: 0,
        null_runs=NullRuns(tasks=(), counting={}, unused=()),
    )  # fmt: skip
    return summarise(Plan(runs=len(told), seed=1), [runs]).as_dict()["outcomes"]


def test_not_injected_runs_are_no_part_of_the_other_shares():
    found = outcomes(["sdc", "benign", "not_injected", "not_injected"])
    assert (found["sdc"]["share"], found["sdc"]["of"]) == (0.5, 2)
    assert (found["not_injected"]["share"], found["not_injected"]["of"]) == (0.5, 4)
    assert outcomes(["not_injected"])["sdc"]["share"] is None


def test_runs_of_few_windows_have_a_wider_interval():
    half = ["sdc", "benign"] * 50
    alone, alike = outcomes(half)["sdc"], outcomes(half, windows=2)["sdc"]
    assert alike["share"] == alone["share"] == 0.5
    (low, high), (lower, higher) = alone["wilson95"], alike["wilson95"]
    assert higher - lower > 2.0 * (high - low)
