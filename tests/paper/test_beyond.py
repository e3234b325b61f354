"""From kernel to mission, where a bit hurts, failures an hour, and the arms of a campaign."""

import math

import pytest
from made_flights import flights, row

from mavfi_cli.paper.beyond import (
    Arm,
    arms,
    companion_arms,
    hourly_failures,
    kernel_flows,
    restarts,
    state_map,
)

LOST = {"outcome": "timeout"}


def struck_kernel(seed, **how):
    told = {"struck_kernel": "rrtstar", "instruction": True, "seed": seed, **how}
    return row("planning", **told)


def test_a_struck_kernel_is_told_by_the_flight():
    rows = [row(seed=seed) for seed in range(1, 7)]
    rows += [
        struck_kernel(1, activation="overwritten", injected="not_activated"),
        struck_kernel(2),
        struck_kernel(3, time_s=21.0),
        struck_kernel(4, node_ended="killed by SIGSEGV", **LOST),
        struck_kernel(5, node_ended="hang"),
        struck_kernel(6, **LOST),
    ]
    (flow,) = kernel_flows(flights(rows), {"rrtstar": (30, 100)})
    counts = {fate: (each.count, each.total) for fate, each in flow.fates.items()}
    assert counts == {
        "never read": (0, 1), "same flight": (0, 1), "changed flight": (1, 2), "crashed": (1, 1),
        "hung": (0, 1),
    }  # fmt: skip
    assert (flow.lost.count, flow.harmed.count) == (2, 2)
    assert flow.given_silent[0] == pytest.approx((1 / 6) / 0.3)  # one lost without a crash


def test_a_quotient_above_1_is_no_probability():
    rows = [row(seed=1), struck_kernel(1, **LOST)]
    (flow,) = kernel_flows(flights(rows), {"rrtstar": (1, 100)})
    assert flow.given_silent is None


def test_a_state_is_told_by_its_highest_bit():
    rows = [row(seed=seed) for seed in (1, 2, 3)]
    where = {"strike_phase": "flying"}
    rows += [
        row("planning", seed=1, struck_state="waypoint_x", struck_bits=[[62]], **where, **LOST),
        row("waypoint_position", seed=2, struck_state="waypoint_x;waypoint_y",
            struck_bits=[[3], [63]], **where),
        row("planning", seed=3, struck_state="plan_trajectory_seq", struck_bits=[[15]], **where),
    ]  # fmt: skip
    cells = state_map(flights(rows))
    found = {(each.state, each.bits, each.phase): each.lost.count for each in cells}
    assert found.keys() == {
        ("waypoint_x", "exponent 62 to 57", "flying"),
        ("waypoint_position", "bit 63, sign", "flying"),
        ("plan_trajectory_seq", "bits 15 to 8", "flying"),
    }
    assert found["waypoint_x", "exponent 62 to 57", "flying"] == 1


def test_failures_an_hour_follow_the_rate_and_the_detector():
    rows = [row(seed=seed) for seed in (1, 2)]
    rows += [row("planning", seed=1, **LOST), row("planning", seed=2)]
    rows += [row("planning", seed=seed, detector="aad") for seed in (1, 2)]
    (found,) = hourly_failures(flights(rows), 0.5)
    assert found.where == "state: planning, sparse"
    assert found.per_hour[""][0] == pytest.approx(0.25)
    assert found.per_hour["aad"][0] == 0.0


def test_faults_of_other_kinds_are_counted_apart():
    rows = [row(seed=1), row("time_to_collision", seed=1, fault={"together": True})]
    rows += [
        row("waypoint_position", seed=1, fault=how, **LOST)
        for how in ({}, {"field": "exponent", "together": True}, {"bits": 5})
    ]
    found = {each.where: each.lost[""].total for each in hourly_failures(flights(rows), 1.0)}
    assert found == {
        "state: waypoint_position, sparse": 1,
        "state: waypoint_position, exponent, all components, sparse": 1,
        "state: waypoint_position, 5 bits, sparse": 1,
        "state: time_to_collision, sparse": 1,
    }


def test_a_detector_of_one_stage_is_not_counted_as_one_of_all_stages():
    rows = [row(seed=1), row("planning", seed=1, **LOST)]
    rows.append(row("planning", seed=1, detector="gad"))
    rows += [row("planning", seed=1, detector="gad", protect=("control",), **LOST)]
    (found,) = hourly_failures(flights(rows), 1.0)
    assert (found.lost["gad"].count, found.lost["gad"].total) == (0, 1)


def test_arms_are_counted_on_the_faults_that_the_unprotected_flight_read():
    guard = {"config": {"stack": "mavbench:guards_tracking=true"}}
    rows = []
    for seed in range(1, 8):
        lost = LOST if seed < 7 else {}
        read = "overwritten" if seed == 6 else "read"
        rows += [row(seed=seed), row("waypoint_position", seed=seed, activation=read, **lost)]
        rows += [row("waypoint_position", seed=seed, **guard)]
    plain, guarded = arms(flights(rows))["mavbench"]
    assert (plain.name, guarded.name) == ("unprotected", "tracking guard")
    assert (plain.lost.count, plain.lost.total) == (5, 6)
    assert (guarded.lost.count, guarded.lost.total) == (0, 6)
    assert guarded.by_site["position"].total == 6
    assert guarded.p_value == guarded.corrected_p == pytest.approx(2 / 2**5)
    assert plain.p_value is None


def test_variants_of_the_stack_with_all_checks_are_arms_of_their_own():
    rows = [row("planning", seed=1, **LOST)]
    for stack in ("mavbench-protected", "mavbench-protected:guards_tracking=true"):
        lost = LOST if ":" in stack else {}
        rows.append(row("planning", seed=1, config={"stack": stack}, **lost))
    found = {arm.name: arm.lost.count for arm in arms(flights(rows))["mavbench"]}
    assert found == {
        "unprotected": 1, "all four checks": 0, "all four checks with tracking guard": 1,
    }  # fmt: skip


def test_the_unprotected_arm_alone_compares_nothing():
    rows = [row("planning", seed=1, config={"stack": stack}) for stack in ("mavbench", "hardened")]
    assert arms(flights(rows)) == {}


def test_one_stack_has_no_arms():
    rows = [row(seed=1), row("planning", seed=1), row("planning", seed=1, detector="gad")]
    assert arms(flights(rows)) == {}


def on(stack, target=None, **how):
    return row(target, config={"stack": stack}, **how)


def test_any_stack_has_arms_and_only_protections_are_mechanisms():
    """Equal settings are equal however they are written, and a smoothing protects nothing."""
    base, other = "mavbench-replica", "mavbench-replica:smoother=release"
    variants = (
        "standby = ['planner']",
        "processes=[],restores_counters=true",
        "goal_tolerance_m=2",
    )
    rows = [row("planning", seed=1), on(base, "planning", seed=1), on(other, "planning", seed=1)]
    rows += [on(f"{base}:{each}", "planning", seed=1) for each in variants]
    rows += [on("not:a=stack=", "planning", seed=1)]
    rows += [on(f"{base}:standby=['planner']", "planning", detector="aad", seed=1)]
    names = ["unprotected", "hot standby", "supervisor with a process for each node",
             "hot standby and AAD"]  # fmt: skip
    found = arms(flights(rows))
    assert {stack: [arm.name for arm in mine] for stack, mine in found.items()} == {base: names}
    every = {arm.name for arm in arms(flights(rows), every=True)[base]}
    assert every - {*names} == {"smoothing of the release", "goal_tolerance_m=2"}


def test_an_arm_is_compared_with_the_golden_flight_that_is_most_like_its_own():
    shared, supervised = "mavbench:processes=[]", "mavbench:restores_counters=true,processes=[]"
    rows = [on("mavbench", seed=1, time_s=20.0), on(shared, seed=1, time_s=30.0)]
    rows += [on("mavbench", seed=2, time_s=20.0), on(shared, seed=2, **LOST)]
    rows += [on("mavbench", seed=3, time_s=20.0)]
    for seed in (1, 2, 3):
        rows += [on("mavbench", "planning", seed=seed, **LOST)]
        rows += [on(supervised, "planning", seed=seed, time_s=30.0)]
    mine = Arm.by_base(flights(rows))["mavbench"]
    (name,) = {*mine["detector"]} - {None, "a process for each node"}
    seen = mine.chosen(detector=name)
    assert seen["bare_lost"] == [True, True, True]
    assert seen["own_flight_time_s"] == [30.0, 20.0, 20.0]
    assert seen["own_lost"] == [False, True, False]
    assert seen["harmed"] == [False, None, True]
    assert mine.balance(name).pairs == 2


def test_arms_are_compared_under_the_same_restart_rule_and_injector():
    supervised = {"stack": "mavbench:restores_counters=true"}
    rows = [row(seed=1), under(1.0, 1, **LOST), under(1.0, 1, supervised)]
    rows += [under(3600.0, 1), under(1.0, 1, fault={"compat": "rosfi-2021"})]
    balance = Arm.by_base(flights(rows))["mavbench"].balance("supervisor", column="lost")
    assert (balance.pairs, balance.undone) == (1, 1)
    rows = [row(seed=1), under(3600.0, 1, **LOST), under(1.0, 1, supervised)]
    assert Arm.by_base(flights(rows))["mavbench"].balance("supervisor").pairs == 0


# When a dead node comes back ----------------------------------------------------------------------


def under(restart_s, seed, config=None, **how):
    rule = {"node_restart_s": restart_s, **(config or {})}
    return row("planning", instruction=True, seed=seed, config=rule, **how)


def test_restart_rules_are_compared_on_the_faults_that_all_of_them_flew():
    died = {"node_ended": "killed by SIGSEGV"}
    rows = [row(seed=seed) for seed in range(1, 5)]
    rows += [row("planning", instruction=True, seed=seed) for seed in (1, 2)]  # 1 s, the default
    rows += [row("planning", instruction=True, seed=3, **died)]
    rows += [row("planning", instruction=True, seed=4, **died, **LOST)]  # without a partner
    rows += [under(3600.0, 1), under(3600.0, 2, **LOST), under(3600.0, 3, **died, **LOST)]
    (found,) = restarts(flights(rows))
    assert found.rules == ("back after 1 s", "never back")
    assert [each.counts for each in found.success.values()] == ["3 of 3", "1 of 3"]
    assert {rule: [each.counts for each in lost.values()] for rule, lost in found.lost.items()} == {
        "back after 1 s": ["0 of 2", "0 of 1"],
        "never back": ["1 of 2", "1 of 1"],
    }
    assert (found.golden.counts, found.paper) == ("4 of 4", [95.0, 88.3, 94.3, 95.0])
    assert found.watched == {}
    assert found.p_value == 0.5


def test_detectors_are_compared_under_each_rule_on_faults_that_all_of_them_flew():
    rows = [row(seed=seed) for seed in (1, 2, 3)]
    for restart_s in (1.0, 3600.0):
        for seed in (1, 2, 3):
            end = LOST if seed == 1 or restart_s > 1.0 else {}
            rows += [under(restart_s, seed, **end)]
            rows += [under(restart_s, seed, detector="gad", **end)] if seed < 3 else []
            rows += [under(restart_s, seed, detector="aad")]
    rows += [under(5.0, seed) for seed in (1, 2)]  # without a detector
    (found,) = restarts(flights(rows))
    assert {
        rule: [each.counts for each in mine.values()] for rule, mine in found.watched.items()
    } == {
        "back after 1 s": ["1 of 2", "1 of 2", "2 of 2"],
        "never back": ["0 of 2", "0 of 2", "2 of 2"],
    }
    assert found.rules == ("back after 1 s", "back after 5 s", "never back")


def test_restart_rules_are_compared_by_injector_and_without_lost_golden_flights():
    rows = [row(seed=1), row(seed=2, **LOST)]
    for seed, compat in ((1, {}), (1, {"compat": "rosfi-2021"}), (2, {})):
        for restart_s in (1.0, 3600.0):
            lost = LOST if compat or seed == 2 else {}
            rows.append(under(restart_s, seed, fault=compat, **lost))
    own, released = restarts(flights(rows))
    assert (own.place, released.place) == ("mavbench", "mavbench, rosfi-2021")
    assert [each.counts for each in own.success.values()] == ["1 of 1", "1 of 1"]
    assert [each.counts for each in released.success.values()] == ["0 of 1", "0 of 1"]


def test_restart_rules_in_fixed_worlds_are_compared_apart_from_those_in_others():
    rows = []
    for config in ({}, {"world_seed": 4}):
        lost = LOST if config else {}
        rows += [
            row(seed=1, config=config),
            under(1.0, 1, config),
            under(3600.0, 1, config, **lost),
        ]
    fixed, many = restarts(flights(rows))
    assert fixed.place == "mavbench, fixed worlds"
    assert many.place == "mavbench, another world for each seed"
    assert [each.counts for each in fixed.success.values()] == ["1 of 1", "0 of 1"]
    assert [each.counts for each in many.success.values()] == ["1 of 1", "1 of 1"]
    assert fixed.golden.counts == many.golden.counts == "1 of 1"


def test_one_restart_rule_is_no_comparison():
    assert not restarts(flights([row(seed=1), under(5.0, 1)]))


def test_a_users_companion_is_counted_with_and_without_its_gate():
    config = {"companion": "my/fly.toml", "autopilot": "px4"}
    rows = [row(seed=1, config=config), row(seed=2, config=config, detector="gad", alarm_count=1)]
    for seed in range(1, 21):
        mine = {"seed": seed, "instruction": True, "config": config}
        rows += [row("fly/server", **mine, node_ended="killed by SIGSEGV", **LOST)]
        rows += [row("fly/server", **mine, detector="gad", alarm_count=seed % 2)]
        rows += [row("fly/other", **mine, detector="gad", **LOST)]
    message = "output.ATTITUDE_TARGET.thrust"
    rows += [
        row(message, config=config, fault={"persistence": "stuck-at", "duration_s": 5.0}, **LOST),
        row(message, config=config),
        row("fly/server", seed=30, instruction=True, config=config, injected="null", **LOST),
        row(seed=40),  # not of a companion
        row("planning", seed=40, **LOST),
    ]
    found = {(arm.fault, arm.gate): arm for arm in companion_arms(flights(rows))}
    assert {arm.companion for arm in found.values()} == {"my/fly.toml on px4, sparse"}
    counts = {key: [each.counts for each in arm.lost.values()] for key, arm in found.items()}
    assert counts == {
        ("", ""): ["0 of 1"],
        ("", "gad"): ["0 of 1"],
        ("fly/other", "gad"): ["20 of 20", "20 of 20", "0 of 0"],
        ("fly/server", ""): ["20 of 20", "0 of 0", "20 of 20"],
        ("fly/server", "gad"): ["0 of 20", "0 of 20", "0 of 0"],
        (message, ""): ["0 of 1", "0 of 1", "0 of 0"],
        (f"{message}, duration_s=5.0, persistence=stuck-at", ""): ["1 of 1", "1 of 1", "0 of 0"],
    }
    assert found["", "gad"].alarmed.counts == "1 of 1"
    assert found["fly/server", "gad"].alarmed.counts == "10 of 20"
    assert found["fly/server", "gad"].p_value < 1e-9
    assert found["fly/server", ""].p_value is None
    assert found["fly/other", "gad"].p_value is None  # not flown without the gate


def test_times_of_a_users_companion_stand_beside_the_spread_of_its_golden_flights():
    config = {"companion": "fly.toml"}
    rows = [
        row(seed=1, config=config, time_s=20.0, distance_m=10.0),
        row(seed=2, config=config, time_s=22.0, distance_m=12.0),
        row(seed=3, config=config, detector="gad", time_s=25.0),
        row("fly", seed=4, instruction=True, config=config, time_s=24.0, distance_m=15.0),
        row("fly", seed=5, instruction=True, config=config, time_s=28.0, distance_m=15.0),
        row("fly", seed=6, instruction=True, config=config, **LOST, distance_m=99.0),
        row("fly", seed=7, instruction=True, config={"companion": "other.toml"}),
    ]
    golden, gated, faulty, alone = companion_arms(flights(rows))
    assert golden.golden is alone.golden is None
    assert gated.golden == faulty.golden == golden
    assert (golden.means["flight_time_s"].value, golden.means["distance_m"].value) == (21.0, 11.0)
    assert golden.deviations["flight_time_s"] == pytest.approx(math.sqrt(2.0))
    assert (faulty.means["flight_time_s"].count, faulty.means["flight_time_s"].value) == (2, 26.0)
    difference = faulty.differences["flight_time_s"]
    assert (difference.value, difference.low < 0.0 < difference.high) == (5.0, True)
    assert faulty.differences["distance_m"].value == 4.0
    assert math.isnan(gated.deviations["flight_time_s"])
    assert alone.differences == {}
