import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavfi_cli.core.errors import FaultError, FaultSpecError, UnknownName
from mavfi_cli.core.flight_record import Strike
from mavfi_cli.core.types import (
    BY_NAME,
    STATES,
    CollisionReport,
    Command,
    DType,
    Message,
    Stage,
    Trajectory,
)
from mavfi_cli.fi.bits import NUMPY_TYPES, Field
from mavfi_cli.fi.fault import (
    GROUPS,
    Corruption,
    Effect,
    Persistence,
    Trigger,
    When,
    draw_fault,
)
from mavfi_cli.fi.injector import Activation, MemoryInjector, Moment, SourceInjector

TRAJECTORY = Trajectory(
    stamp_s=0.0,
    waypoints=np.linspace(0.5, 40.0, 60).reshape(6, 10),
    durations_s=np.full(6, 0.5),
    trajectory_seq=3,
    future_collision_seq=1,
)
REPORT = CollisionReport(
    stamp_s=0.0, collision=True, time_to_collision_s=2.5, future_collision_seq=3
)
COMMAND = Command(stamp_s=0.0, velocity_enu_mps=np.array([1.0, -2.0, 0.5]), yaw_rad=0.25)
MESSAGES: dict[type, Message] = {
    Trajectory: TRAJECTORY, CollisionReport: REPORT, Command: COMMAND,
}  # fmt: skip
NOW = Trigger(when=When.TIME, number=0.0)


def moment(flight_s: float = 0.0, tick: int = 0, phase: str = "flying") -> Moment:
    return Moment(stamp_s=10.0 + flight_s, flight_s=flight_s, tick=tick, phase=phase)


def make(target: str, seed: int = 1, told: list[Strike] | None = None, **options) -> SourceInjector:
    corruption = Corruption(**options.pop("corruption", {}))
    options.setdefault("trigger", NOW)
    fault = draw_fault(target, seed=seed, corruption=corruption, **options)
    listener = (told if told is not None else []).append
    return SourceInjector(fault, seed=seed, shortest_flight_s=16.0, listener=listener)


def send(injector: SourceInjector, message: Message, when: Moment) -> Message:
    """One message on its way, as the companion passes it."""
    if isinstance(message, Trajectory) and injector.fault.trigger.when is not When.INVOCATION:
        return injector.strike_latched(message, when, 0)
    return injector.pass_on(message, when)


def values(message: Message) -> dict[tuple[str, int], float]:
    rows = len(message.waypoints) if isinstance(message, Trajectory) else 1
    return {
        (s.name, row): s.read(message, row)
        for s in STATES if s.message is type(message) for row in range(rows)
    }  # fmt: skip


@pytest.mark.parametrize("state", STATES, ids=lambda s: s.name)
@given(seed=st.integers(0, 10_000), bits=st.integers(1, 5))
def test_exactly_the_drawn_bits_of_one_value_change(state, seed, bits):
    kind = NUMPY_TYPES[state.dtype.value]
    bits = min(bits, kind.width)
    told: list[Strike] = []
    injector = make(state.name, seed, told, corruption={"bits": bits})
    message = MESSAGES[state.message]
    before, after = values(message), values(send(injector, message, moment()))
    assert values(message) == before  # the sender's copy stays as it was
    changed = {
        key for key in before
        if kind_of(key).pattern(before[key]) != kind_of(key).pattern(after[key])
    }  # fmt: skip
    (change,) = told[0].changes
    assert changed <= {(state.name, change.index)} | shadows(state.name, message, change.index)
    assert len(change.bits) == bits
    xor = int(change.before_hex, 16) ^ int(change.after_hex, 16)
    assert xor.bit_count() == bits
    assert kind.pattern(before[state.name, change.index]) == int(change.before_hex, 16)


def kind_of(key):
    return NUMPY_TYPES[BY_NAME[key[0]].dtype.value]


def shadows(name, message, index):
    """Sequence numbers and flags belong to the whole message: they read the same in every row."""
    rows = len(message.waypoints) if isinstance(message, Trajectory) else 1
    return {(name, row) for row in range(rows)} if name.startswith("plan_") else set()


FLOATS = [s.name for s in STATES if s.dtype is DType.FLOAT64]
FIELDS = [Field.SIGN, Field.EXPONENT, Field.MANTISSA]


@given(st.sampled_from(FLOATS), st.sampled_from(FIELDS), st.integers(0, 999))
def test_the_field_is_respected(name, field, seed):
    told: list[Strike] = []
    injector = make(name, seed, told, corruption={"field": field})
    send(injector, MESSAGES[BY_NAME[name].message], moment())
    assert set(told[0].changes[0].bits) <= set(NUMPY_TYPES["float64"].field_bits(field))


def test_all_components_of_a_group_are_struck_each_with_its_own_bits():
    told: list[Strike] = []
    injector = make("waypoint_ax", 5, told, together=True)
    send(injector, TRAJECTORY, moment())
    changes = told[0].changes
    assert [c.state for c in changes] == ["waypoint_ax", "waypoint_ay", "waypoint_az"]
    assert len({c.bits for c in changes}) > 1
    assert len({c.index for c in changes}) == 1


@pytest.mark.parametrize("stage", list(Stage))
def test_a_stage_stands_for_any_of_its_states(stage):
    drawn = {
        draw_fault(stage.value, seed=s, trigger=NOW, corruption=Corruption()).states[0].name
        for s in range(300)
    }
    assert drawn == {s.name for s in STATES if s.stage is stage}


@pytest.mark.parametrize("group", GROUPS)
def test_a_group_stands_for_any_of_its_states(group):
    drawn = {
        draw_fault(group, seed=s, trigger=NOW, corruption=Corruption()).states[0]
        for s in range(100)
    }
    assert {s.name for s in drawn} == {s.name for s in STATES if s.group == group}


@pytest.mark.parametrize(
    ("trigger", "moments", "expected"),
    [
        (Trigger(when=When.TIME, number=1.0), [moment(0.98), moment(1.0), moment(1.02)], 1),
        (Trigger(when=When.TICK, number=7), [moment(tick=6), moment(tick=7)], 1),
        (Trigger(when=When.PHASE, phase="slowing"), [moment(), moment(phase="slowing")], 1),
        (Trigger(when=When.INVOCATION, number=3), [moment(), moment(), moment(), moment()], 2),
    ],
)
def test_triggers_strike_once_at_their_moment(trigger, moments, expected):
    told: list[Strike] = []
    injector = make("command_vx", told=told, trigger=trigger)
    struck = [send(injector, COMMAND, m) is not COMMAND for m in moments]
    assert struck == [number == expected for number in range(len(moments))]
    assert len(told) == 1


@pytest.mark.parametrize(
    ("trigger", "moments"),
    [
        (Trigger(when=When.PHASE, phase="evading"), [moment(), moment(phase="evading")]),
        (
            Trigger(when=When.FORESEEN),
            [moment(), moment()._replace(foresees=True), moment(phase="flying")],
        ),
    ],
)
def test_the_first_message_after_a_trigger_that_is_over_is_struck(trigger, moments):
    """A phase lasts less than the time between two reports."""
    told: list[Strike] = []
    injector = make("time_to_collision", told=told, trigger=trigger)
    assert send(injector, REPORT, moment()) is REPORT
    for seen in moments:
        injector.watch(seen)
    later = moment(flight_s=0.3, tick=15)
    assert send(injector, REPORT, later) is not REPORT
    assert [(strike.tick, strike.phase) for strike in told] == [(15, "flying")]
    assert send(injector, REPORT, later) is REPORT


@pytest.mark.parametrize(
    ("trigger", "seen", "reason"),
    [
        (Trigger(when=When.PHASE, phase="evading"), moment(), "never in phase evading"),
        (Trigger(when=When.PHASE, phase="evading"), moment(phase="evading"), "after phase evading"),
        (Trigger(when=When.FORESEEN), moment(), "no collision"),
        (Trigger(when=When.TIME, number=2.0), moment(1.0), "ended before the trigger"),
        (Trigger(when=When.TIME, number=2.0), moment(2.0), "no report came after the trigger"),
        (Trigger(when=When.INVOCATION, number=2), moment(9.0), "ended before the trigger"),
    ],
)
def test_why_nothing_was_struck_is_true(trigger, seen, reason):
    injector = make("time_to_collision", trigger=trigger)
    injector.watch(seen)
    assert reason in injector.missed


def test_a_random_moment_is_uniform_over_the_flight():
    drawn = [make("command_vx", s, trigger=Trigger()).drawn_time_s for s in range(2000)]
    assert min(drawn) >= 0.0
    assert max(drawn) <= 16.0
    # Mean of n uniforms over T: sigma = T / sqrt(12 n); four sigma.
    assert abs(np.mean(drawn) - 8.0) < 4.0 * 16.0 / math.sqrt(12 * 2000)


def test_stuck_bits_stay_for_the_duration_and_no_longer():
    corruption = {"persistence": Persistence.STUCK_AT, "duration_s": 0.1, "field": Field.SIGN}
    injector = make("command_vx", trigger=NOW, corruption=corruption)
    signs = []
    for tick in range(8):
        flown = replace(COMMAND, velocity_enu_mps=COMMAND.velocity_enu_mps * (-1.0) ** tick)
        sent = send(injector, flown, moment(0.02 * tick))
        signs.append(math.copysign(1.0, sent.velocity_enu_mps[0]))
    assert signs == [-1.0] * 5 + [-1.0, 1.0, -1.0]  # struck five times, then left alone


def test_an_intermittent_fault_returns_every_period():
    corruption = {"persistence": Persistence.INTERMITTENT, "period_s": 0.06, "field": Field.SIGN}
    told: list[Strike] = []
    injector = make("command_vx", told=told, corruption=corruption)
    for tick in range(10):
        send(injector, COMMAND, moment(0.02 * tick, tick))
    assert [strike.tick for strike in told] == [0, 3, 6, 9]


def test_what_a_second_strike_leaves_as_it_is_may_still_be_read():
    """The value is zero since the first strike, and nobody has read it yet."""
    told: list[Strike] = []
    corruption = {"effect": Effect.ZERO, "persistence": Persistence.INTERMITTENT}
    injector = make("waypoint_x", told=told, corruption=corruption)
    struck = injector.strike_latched(TRAJECTORY, moment(0.0), 0)
    again = injector.strike_latched(struck, moment(1.0), 0)
    assert [bool(strike.changes[0].bits) for strike in told] == [True, False]
    injector.follower.settle(lambda message: message is again)
    injector.follower.read(again, "control", 11.5, {"waypoint_x"}, told[0].changes[0].index)
    assert injector.follower.activation is Activation.READ


def test_zero_and_random_values():
    told: list[Strike] = []
    zeroed = send(make("command_yaw", corruption={"effect": Effect.ZERO}), COMMAND, moment())
    assert zeroed.yaw_rad == 0.0
    drawn = {
        send(make("command_yaw", s, told, corruption={"effect": Effect.RANDOM}), COMMAND, moment())
        .yaw_rad for s in range(20)
    }  # fmt: skip
    assert len(drawn) > 15


def test_a_fault_in_a_plan_hits_the_one_that_is_flown_at_or_after_its_present_waypoint():
    told: list[Strike] = []
    for seed in range(40):
        injector = make("waypoint_vx", seed, told)
        assert injector.pass_on(TRAJECTORY, moment()) is TRAJECTORY
        assert injector.strike_latched(TRAJECTORY, moment(), 4) is not TRAJECTORY
    assert {strike.changes[0].index for strike in told} == {4, 5}


def test_the_listener_hears_before_the_message_goes_on():
    heard = []
    fault = draw_fault("command_vx", seed=1, trigger=NOW, corruption=Corruption())
    injector = SourceInjector(
        fault, seed=1, shortest_flight_s=1.0, listener=lambda s: heard.append(s.changes[0].after)
    )
    sent = send(injector, COMMAND, moment())
    assert heard == [sent.velocity_enu_mps[0]]


@pytest.mark.parametrize(
    ("target", "options", "error", "message"),
    [
        ("waypoint_vq", {}, UnknownName, "did you mean 'waypoint_v"),
        ("command_vx", {"bits": [64]}, FaultError, "64"),
        ("collision", {"bits": [1]}, FaultError, "bool"),
        (
            "future_collision_seq",
            {"corruption": {"field": Field.MANTISSA}},
            FaultError,
            "int32",
        ),
        ("collision", {"corruption": {"bits": 2}}, FaultSpecError, "at most 1, got 2"),
    ],
)
def test_what_does_not_fit_is_said(target, options, error, message):
    with pytest.raises(error, match=message) as raised:
        make(target, **options)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    "options", [{"bits": 0}, {"duration_s": 0.0}, {"period_s": 0.0}, {"period_s": math.inf}]
)
def test_impossible_corruptions(options):
    with pytest.raises(FaultSpecError):
        Corruption(**options)


@pytest.mark.parametrize("options", [{"number": -1.0}, {"number": math.nan}])
def test_impossible_triggers(options):
    with pytest.raises(FaultSpecError):
        Trigger(when=When.TIME, **options)


@pytest.mark.parametrize("stage", [stage.value for stage in Stage])
@pytest.mark.parametrize("field", [Field.EXPONENT, Field.MANTISSA])
def test_of_a_stage_only_states_that_have_the_field_are_drawn(stage, field):
    corruption = Corruption(field=field)
    drawn = [
        draw_fault(stage, seed=seed, trigger=Trigger(), corruption=corruption).states[0]
        for seed in range(60)
    ]
    assert {state.dtype.value for state in drawn} == {"float64"}
    able = {state.name for state in Stage(stage).states if state.dtype.value == "float64"}
    assert {state.name for state in drawn} == able


@pytest.mark.parametrize(
    ("corruption", "bits", "error", "message"),
    [
        (Corruption(bits=2, field=Field.SIGN), None, FaultSpecError, "sign .*at most 1, got 2"),
        (Corruption(bits=65), None, FaultSpecError, "mean is float64: .*any"),
        (Corruption(), [64], FaultError, "64"),
    ],
)
def test_bits_that_a_memory_does_not_have_are_refused_before_the_flight(
    corruption, bits, error, message
):
    with pytest.raises(error, match=message):
        MemoryInjector(
            {"mean": np.zeros(3)},
            None,
            trigger=Trigger(),
            corruption=corruption,
            bits=bits,
            seed=1,
            shortest_flight_s=10.0,
            listener=lambda _: None,
        )
