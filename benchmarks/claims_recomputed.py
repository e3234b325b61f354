"""Recomputes the report's claims from exported missions, with pandas and SciPy alone.

Each claim about faults is recomputed for all faults, for silent ones and for those that end a node.

    python benchmarks/claims_recomputed.py EXPORT.parquet KERNELS.json

No code of `mavfi_cli` computes these numbers: the rules are those of docs/explanation/claims.md,
and the paper's numbers are typed in once more. The last step compares n, effect, interval and
verdict with those of `mavfi report`. Ends of drawn intervals (bootstrap, posterior draws) may
differ by their noise, 10 % of the interval's width. All other numbers must be equal to nine digits.
"""

from __future__ import annotations

import argparse
import json
import math
from collections import defaultdict
from pathlib import Path

import numpy as np
import pandas as pd
from scipy import stats

Z = stats.norm.ppf(0.975)
WORLDS = ("factory", "farm", "sparse", "dense")
ALL = "perception+planning+control"


# Intervals: (effect, low, high, n) ----------------------------------------------------------------


def wilson(hits, n, z=Z):
    """Return the rate of `hits` among `n`, and the ends of its Wilson interval."""
    p = hits / n
    centre = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return p, 0.0 if hits == 0 else centre - half, 1.0 if p == 1 else centre + half


def rate(frame, column, value=True):
    """Return the rate of a value in a column, its Wilson interval and n, or None without rows.

    The interval includes the design effect of worlds as strata and seeds as clusters.
    """
    rows = frame[frame[column].notna()]
    if not len(rows):
        return None
    y = (rows[column].astype(bool) == value).astype(float)
    n, p = len(rows), y.mean()
    if 0 < p < 1:
        variance = 0.0
        for _, part in (y - p).groupby(rows.world):
            sums = part.groupby(rows.seed).sum()
            g = max(2, len(sums))
            variance += g / (g - 1) * ((sums**2).sum() - sums.sum() ** 2 / g)
        effect = max(1.0, variance / (n * p * (1 - p)))
    else:
        effect = 1.0
    return (*wilson(y.sum() / effect, n / effect), n)


def minus(a, b):
    """Return the difference of two rates, `a` minus `b`, with Newcombe's hybrid interval.

    It is None if one of the rates is None.
    """
    if a is None or b is None:
        return None
    value = a[0] - b[0]
    low = value - math.hypot(a[0] - a[1], b[2] - b[0])
    high = value + math.hypot(a[2] - a[0], b[0] - b[1])
    return value, max(-1.0, low), min(1.0, high), min(a[3], b[3])


def cluster_effect(change, seeds):
    """Return the design effect, at least 1, of seeds as clusters on a mean change."""
    residual = change - change.mean()
    sums = residual.groupby(seeds).sum()
    if (residual**2).sum() == 0 or len(sums) in (1, len(change)):
        return 1.0
    return max(1.0, len(sums) / (len(sums) - 1) * (sums**2).sum() / (residual**2).sum())


def bonett_price(first, second, seeds):
    """Return the rate of `second` minus that of `first` in the same missions.

    The interval is that of Bonett and Price. The result is None without missions.
    """
    if not len(first):
        return None
    change = second.astype(int) - first.astype(int)
    n = len(change) / cluster_effect(change, seeds)
    up, down = ((n * (change == sign).mean() + 1) / (n + 2) for sign in (1, -1))
    half = Z * math.sqrt((up + down - (up - down) ** 2) / (n + 2))
    return change.mean(), max(-1.0, up - down - half), min(1.0, up - down + half), len(change)


def net(before, after, seeds, rng):
    """Return the net share of harm undone: harm undone minus harm caused, over the harm before.

    The result is None if fewer than 5 missions were harmed before.
    """
    if before.sum() < 5:
        return None
    effect = cluster_effect(after.astype(int) - before.astype(int), seeds)
    counts = (
        (before.sum(), len(before)),
        ((before & ~after).sum(), before.sum()),
        ((~before & after).sum(), (~before).sum()),
    )
    hit, back, new = (
        stats.beta(k / effect + 0.5, (n - k) / effect + 0.5).rvs(200_000, random_state=rng)
        for k, n in counts
    )
    low, high = np.percentile(back - new * (1 - hit) / hit, [2.5, 97.5])
    value = (before.sum() - after.sum()) / before.sum()
    return value, min(value, low), max(value, high), len(before)


def mean(values, frame):
    """Return the mean over the means of clusters, its BCa bootstrap interval, and n."""
    known = values.notna()
    means = values[known].groupby([frame.world[known], frame.seed[known]]).mean()
    n = int(known.sum())
    if not n:
        return None
    if means.nunique() == 1:
        return means.iloc[0], means.iloc[0], means.iloc[0], n
    ends = stats.bootstrap(
        (means.to_numpy(),), np.mean, method="BCa", random_state=3, batch=500
    ).confidence_interval
    return means.mean(), ends.low, ends.high, n


# Flights ------------------------------------------------------------------------------------------


def prepare(path):
    """Return the paper's flown missions, with columns of their golden and unprotected flights."""
    rows = pd.read_parquet(path)
    rows = rows[(rows.state == "flown") & (rows["stack"] == "mavbench")].copy()
    rows["pair"] = rows.pair.astype(object)  # else pandas maps it to texts
    changes = rows.changes.astype(object).map(json.loads)
    fault = changes.map(
        lambda c: json.dumps([c.get("fault"), c.get("instruction")], sort_keys=True)
    )
    rows["fault"] = fault
    rows["at"] = changes.map(lambda c: (c.get("fault") or {}).get("at", "random"))
    rows = rows[rows["at"] == "random"]
    rows["together"] = changes.map(lambda c: bool((c.get("fault") or {}).get("together")))
    rows["lost"] = rows.outcome != "success"
    rows["dead"] = rows.node_ended.notna()
    rows["struck"] = rows.injected.isin(["active", "unread", "caught", "not_activated"])
    golden = rows[rows.level.isna() & rows.detector.isna()].set_index("pair")
    rows["own_lost"] = rows.pair.map(golden.lost)
    own = rows.pair.map(golden.flight_time_s)
    both = (rows.own_lost == False) & ~rows.lost  # noqa: E712, the column may be empty
    rows["over_own"] = (rows.flight_time_s / own).where(both)
    harmed = rows.lost | (rows.over_own > 1.1)
    rows["harmed"] = harmed.where(rows.own_lost == False).astype(object)  # noqa: E712
    bare = rows[rows.detector.isna()].set_index(["pair", "fault"])
    for name in ("struck", "dead", "lost", "harmed"):
        rows[f"bare_{name}"] = pd.MultiIndex.from_frame(rows[["pair", "fault"]]).map(
            bare[name].to_dict()
        )
    for name in ("energy_regression_j", "replans"):
        rows[f"own_{name}"] = rows.pair.map(golden[name])
    rows["own_time"] = own
    return rows


def of_fate(rows, fate):
    """Return the flights without a fault, and those whose fault has a fate without a detector.

    The fate is "all", "dead" (the fault ends its node) or "silent" (it does not).
    """
    if fate == "all":
        return rows
    ended = rows.dead.where(rows.detector.isna(), rows.bare_dead)
    return rows[rows.level.isna() | (ended == (fate == "dead"))]


class Flights:
    """The missions of an export, with the selections of them that the claims count."""

    def __init__(self, rows):
        self.rows = rows
        self.golden = rows[rows.level.isna() & rows.detector.isna()]
        bare = rows[rows.struck & rows.detector.isna()]
        self.kernels = bare[(bare.level == "instruction") & (bare.world == "sparse")]
        stages = ["perception", "planning", "control"]
        self.stages = bare[(bare.level == "instruction") & bare.fault_target.isin(stages)]
        source = bare[(bare.level == "source") & (bare.world == "sparse")]
        self.states = source[source.together & (source.platform == "x86")]
        self.computers = source[(source.fault_field == "any") & source.fault_target.isin(stages)]

    def state(self, target, bits=1, field=("any",)):
        """Return the missions with a fault in all components of a state at once."""
        rows = self.states
        named = rows.fault_target == target
        return rows[named & (rows.fault_bits == bits) & rows.fault_field.isin(field)]

    def kernel(self, *names):
        """Return the unprotected missions in Sparse with an instruction-level fault in a kernel."""
        return self.kernels[self.kernels.struck_kernel.isin(names)]

    def protected(self, detector, protect=ALL, level="instruction", platform="x86"):
        """Return the flights with a detector whose fault also struck in the unprotected flight.

        Their golden flights succeed.
        """
        rows = self.rows
        seen = (rows.detector == detector) & (rows.protect == protect) & (rows.level == level)
        seen &= (rows.platform == platform) & (rows.own_lost == False)  # noqa: E712
        seen &= rows.bare_struck == True  # noqa: E712
        return rows[seen]


def success_lost(rows):
    """Return the success rate of the golden flights minus that of the flights with a fault."""
    rows = rows[rows.own_lost.notna()]
    seeds = rows.world + rows.seed.astype(str)
    return bonett_price(~rows.lost, ~rows.own_lost.astype(bool), seeds)


def longer(rows):
    """Return the share of successful flights that take over 10 % longer than the golden ones."""
    return rate(rows[rows.over_own.notna()], "harmed")


def change(rows, own, new, ratio=True):
    """Return the mean change of a column from the golden flight, as a ratio or a difference."""
    rows = rows[rows.over_own.notna()]
    difference = rows[new] - rows[own]
    return mean(difference / rows[own] if ratio else difference, rows)


def undone(rows, column, rng):
    """Return the net share of the harm in a column, such as lost missions, that a detector undoes.

    It is None if fewer than 5 missions are harmed without the detector.
    """
    rows = rows[rows[column].notna() & rows[f"bare_{column}"].notna()]
    seeds = rows.world + rows.seed.astype(str)
    before, after = (rows[name].astype(bool) for name in (f"bare_{column}", column))
    return net(before, after, seeds, rng)


def back(rows, rng):
    """Return the net share of longer flights that a detector brings back to normal length."""
    return undone(rows[(rows.bare_lost == False) & ~rows.lost], "harmed", rng)  # noqa: E712


# Ranges -------------------------------------------------------------------------------------------


def margin(n):
    """Return the least effect that n missions can rule out in a family of four claims."""
    z = stats.norm.ppf(1 - 0.05 / 4 / 2)
    return math.ceil(wilson(0, n, z)[2] / 0.005) * 0.005


def more(n):
    """Return the range of effects that confirms a claim about a direction, for n missions."""
    return margin(n), math.inf


def size(value):
    """Return the range of effects that confirms a claim of a size: up to a factor of 3."""
    return value / 3, 3 * value


def share(value):
    """Return the same range for a share, without an upper end if it would reach 1."""
    return value / 3, 3 * value if 3 * value < 1 else math.inf


def verdicts(family):
    """Return the verdicts of a family of claims, each given as its effect and its range.

    A claim's p-value is that of the nearest end of its range. Holm's method corrects the p-values.
    """
    scores = []
    for effect, (low, high) in family:
        if effect is None:
            scores.append(None)
            continue
        value, least, most, _ = effect
        distances = [(value - low, value - least), (high - value, most - value)]
        if value < low:
            distances = [(low - value, most - value)]
        elif value > high:
            distances = [(value - high, value - least)]
        z = min(Z * d / w if w else (math.inf if d else 0.0) for d, w in distances)
        scores.append(2 * stats.norm.sf(z))
    tested = sorted((p, i) for i, p in enumerate(scores) if p is not None)
    worst, corrected = 0.0, {}
    for rank, (p, i) in enumerate(tested):
        worst = max(worst, min(1.0, p * (len(tested) - rank)))
        corrected[i] = worst
    found = []
    for i, (effect, (low, high)) in enumerate(family):
        if effect is None:
            found.append("not decidable")
        elif corrected[i] >= 0.05:
            found.append("undecided")
        else:
            found.append("reproduced" if low <= effect[0] <= high else "contradicted")
    return found


# Claims -------------------------------------------------------------------------------------------


def of_flights(f, kernels, rng):
    """Yield the name, effect and range of each claim about flights."""
    planning = f.kernel("rrt", "rrtconnect", "rrtstar", "control")
    perception = f.kernel("point_cloud", "octomap", "collision_check")
    harm = lambda rows: rate(rows, "harmed")  # noqa: E731
    map_only = f.kernel("point_cloud", "octomap")
    shares = f.kernels.groupby("struck_kernel", sort=False).lost.mean()
    world = {name: f.stages[f.stages.world == name] for name in WORLDS}
    whole = {name: rows[rows.own_lost == False] for name, rows in world.items()}  # noqa: E712
    signs = harm(f.state("waypoint_position", field=("sign", "exponent")))
    accelerated = f.state("waypoint_acceleration")
    yield "fig7-ranking", ranking(f.kernels, kernels, rng), (-math.inf, 0.5)
    yield "fig7-stages", minus(harm(planning), harm(perception)), more(300)
    yield "fig7-map", success_lost(map_only), (-margin(200), margin(200))
    yield "fig7-check", minus(harm(f.kernel("collision_check")), harm(map_only)), more(100)
    yield "fig7-mean", change(f.kernels, "own_time", "flight_time_s"), (-0.05, 0.05)
    yield "fig7-range", minus(longer(planning), longer(f.kernel("octomap"))), more(100)
    yield "fig7-loss", success_lost(f.kernel(shares.idxmax())), size(0.08)
    yield "fig8-seq", minus(harm(f.state("time_to_collision")),
                            harm(f.state("future_collision_seq"))), more(100)  # fmt: skip
    for name in ("position", "yaw", "velocity"):
        yield f"fig8-{name}", harm(f.state(f"waypoint_{name}")), more(100)
    mantissa = harm(f.state("waypoint_position", field=("mantissa",)))
    yield "fig9-fields", minus(signs, mantissa), more(100)
    yield "table3-1", success_lost(accelerated), size(0.08)
    yield "table3-time", change(accelerated, "own_time", "flight_time_s"), size(0.116)
    energy = change(accelerated, "own_energy_regression_j", "energy_regression_j")
    yield "table3-energy", energy, size(0.113)
    yield "table3-replans", change(accelerated, "own_replans", "replans", ratio=False), size(0.36)
    five = f.state("waypoint_acceleration", bits=5)
    yield "table3-5", minus(rate(five, "lost"), rate(accelerated, "lost")), (-0.06, 0.06)
    for name, printed in zip(WORLDS, (1.0, 1.0, 0.95, 0.85), strict=True):
        golden = f.golden[(f.golden.world == name) & (f.golden.platform == "x86")]
        ends = printed - 0.1, printed + 0.1 if printed < 0.9 else math.inf
        yield f"table4-golden-{name}", rate(golden, "lost", value=False), ends
    for name, printed in zip(WORLDS, (0.083, 0.027, 0.067, 0.097), strict=True):
        yield f"table4-{name}", success_lost(world[name]), size(printed)
    dense, farm = (rate(whole[name], "lost") for name in ("dense", "farm"))
    yield "table4-dense-over-farm", minus(dense, farm), size(0.07)
    for name, printed in (("gad", 0.83), ("aad", 0.96)):
        yield f"table4-{name}", undone(f.protected(name), "lost", rng), share(printed)
    gad, aad = (f.protected(name).set_index(["pair", "fault"]) for name in ("gad", "aad"))
    both = gad.index.intersection(aad.index)
    seeds = gad.world[both] + gad.seed[both].astype(str)
    better = bonett_price(~gad.lost[both], ~aad.lost[both], seeds)
    yield "table4-aad-over-gad", better, size(0.009)
    for name in WORLDS:
        yield f"fig12-{name}", longer(world[name]), more(300)
    for name in ("gad", "aad"):
        yield f"fig12-{name}", back(f.protected(name), rng), (0.5, math.inf)
    seen = f.protected("aad")
    gap = minus(*(harm(seen[seen.world == name]) for name in ("dense", "farm")))
    yield "fig12-gap", gap, more(300)
    for name in ("perception", "planning"):
        struck = world["dense"][world["dense"].fault_target == name]
        yield f"fig13-{name}", longer(struck), more(100)
    yield from of_detectors(f, rng)
    yield from of_computers(f, rng)


def of_detectors(f, rng):
    """Yield the name, effect and range of each claim about what detectors undo and cost."""
    for name in ("gad", "aad"):
        arm = {
            protect: undone(f.protected(name, protect), "harmed", rng)
            for protect in ("perception", "planning", "control", "planning+control", ALL)
        }
        alone = arm["perception"], arm["planning"]
        best = None if None in alone else max(alone, key=lambda each: each[0])
        for kind, first, second in (
            ("control", arm["control"], best),
            ("pc", arm["planning+control"], arm["control"]),
            ("all", arm[ALL], arm["planning+control"]),
        ):
            yield f"fig14-{kind}-{name}", mover(first, second), more(100)
    costs = ["check_share", *(f"recovery_share_{s}" for s in ("perception", "planning", "control"))]
    cost = {}
    for name in ("gad", "aad"):
        rows = f.rows
        watched = (rows.detector == name) & (rows.protect == ALL) & (rows.level == "instruction")
        cost[name] = rows[watched & rows.struck]
    gad, aad = cost["gad"], cost["aad"]
    yield "table5-gad", mean(gad[costs].sum(axis=1, skipna=False), gad), size(0.02)
    yield "table5-perception", mean(gad[costs[1]], gad), size(0.0106)
    yield "table5-planning", mean(gad[costs[2]], gad), size(0.0094)
    recovery = mean(aad[costs[1:]].sum(axis=1, skipna=False), aad)
    yield "table5-aad-recovery", recovery, (-math.inf, 1e-6)
    totals = [each.set_index(["pair", "fault"])[costs].sum(axis=1) for each in (gad, aad)]
    dearer = pd.Series((totals[0] - totals[1].reindex(totals[0].index)).to_numpy(), gad.index)
    yield "table5-gad-over-aad", mean(dearer, gad), size(0.02)


def of_computers(f, rng):
    """Yield the name, effect and range of each claim about the TX2."""
    tx2, x86 = (f.computers[f.computers.platform == name] for name in ("tx2", "x86"))
    trend = minus(rate(tx2, "harmed"), rate(x86, "harmed"))
    yield "fig16-trend", trend, (-margin(300), margin(300))
    yield "fig16-time", longer(tx2), more(300)
    for name in ("gad", "aad"):
        seen = f.protected(name, level="source", platform="tx2")
        yield f"fig16-{name}", back(seen, rng), (0.5, math.inf)


def mover(a, b):
    """Return the difference of two effects that may lie outside -1 to 1, with its interval.

    It is None if one of the effects is None.
    """
    if a is None or b is None:
        return None
    value = a[0] - b[0]
    low = value - math.hypot(a[0] - a[1], b[2] - b[0])
    return value, low, value + math.hypot(a[2] - a[0], b[0] - b[1]), min(a[3], b[3])


def ranking(rows, kernels, rng):
    """Return Spearman's correlation, over kernels, of SDC in isolation and harm in flight.

    It is None for fewer than 5 kernels, or if all kernels do equal harm in flight.
    """
    names = sorted(set(rows.struck_kernel) & set(kernels))
    flown = [(rows[rows.struck_kernel == name].harmed.dropna().astype(bool)) for name in names]
    if len(names) < 5 or len({y.mean() for y in flown}) == 1:
        return None
    pairs = [(sum(y), len(y)) for y in flown]
    silent = [(kernels[n]["sdc"]["count"], kernels[n]["sdc"]["of"]) for n in names]
    drawn = [
        stats.beta(k[:, None] + 0.5, (n - k)[:, None] + 0.5).rvs((len(names), 20_000), rng)
        for k, n in (np.array(each).T for each in (silent, pairs))
    ]
    first, second = (stats.rankdata(each, axis=0) - (len(names) + 1) / 2 for each in drawn)
    rho = (first * second).sum(axis=0) / np.sqrt((first**2).sum(axis=0) * (second**2).sum(axis=0))
    value = stats.spearmanr(*([k / n for k, n in each] for each in (silent, pairs))).statistic
    return value, *np.percentile(rho, [2.5, 97.5]), sum(n for _, n in pairs)


def of_kernels(kernels):
    """Yield the name, effect and range of each claim about isolated kernels."""

    def outcome(name, kind):
        found = kernels[name][kind]
        return found["share"], *found["wilson95"], found["of"]

    silent = {name: outcome(name, "sdc") for name in kernels}
    calm = {name: outcome(name, "benign") for name in kernels}
    other = max((silent[x] for x in silent if x != "octomap"), key=lambda each: each[0])
    yield "fig6-octomap", minus(silent["octomap"], other), more(5000)
    least = min((calm[x] for x in calm if x != "octomap"), key=lambda each: each[0])
    yield "fig6-benign", least, (0.25, math.inf)
    yield "fig6-octomap-benign", calm["octomap"], (-math.inf, 0.25)
    yield "fig6-pid", calm["control"], (0.15, 0.35)
    smaller = min(silent["rrt"], silent["rrtconnect"], key=lambda each: each[0])
    below = -math.inf, -margin(5000)
    yield "fig6-rrtstar", minus(silent["rrtstar"], smaller), below
    yield "fig6-rrtconnect", minus(silent["rrtconnect"], silent["rrt"]), below


FATES = ("all", "silent", "dead")
WITHOUT_FATES = ("fig6", "table4-golden", "table5")


def recomputed(export, kernels):
    """Return the effect and verdict of each claim, keyed by its name and the fate of faults."""
    runs = {each["kernel"]: each["outcomes"] for each in json.loads(kernels.read_text())["kernels"]}
    rng = np.random.default_rng(7)
    rows = prepare(export)
    families = defaultdict(dict)
    for name, effect, ends in of_kernels(runs):
        families["all", "fig6"][name] = (effect, ends)
    for fate in FATES:
        for name, effect, ends in of_flights(Flights(of_fate(rows, fate)), runs, rng):
            if fate == "all" or not name.startswith(WITHOUT_FATES):
                families[fate, name.split("-")[0]][name] = (effect, ends)
    found = {}
    for (fate, _), family in families.items():
        told = dict(zip(family, verdicts([*family.values()]), strict=True))
        if told.get("table3-1") == "contradicted":  # the premise of table3-5
            family["table3-5"] = (None, family["table3-5"][1])
            told = dict(zip(family, verdicts([*family.values()]), strict=True))
        found |= {(name, fate): (family[name][0], told[name]) for name in family}
    return found


# Comparison ---------------------------------------------------------------------------------------


def of_mavfi(export, kernels):
    """Return the same effects and verdicts as `mavfi report` computes them."""
    from mavfi_cli.analysis.pairs import Fate
    from mavfi_cli.paper.claims import ISOLATED, judged
    from mavfi_cli.paper.sources import Evidence

    evidence = Evidence.gather([export, kernels])
    flights = evidence.flights("mavbench").chosen(as_paper=True).chosen(at=(None, "random"))
    fates = dict(zip(Fate, FATES, strict=True))
    found = {}
    for each in judged({"mavbench": flights}, evidence.isolated):
        place = ISOLATED if each.claim.isolated else "mavbench"
        for fate, judgement in each.judgements[place].items():
            e = judgement.effect
            numbers = None if e is None else (e.value, e.low, e.high, e.count)
            found[each.claim.name, fates[fate]] = (numbers, judgement.verdict.value)
    return found


DRAWN = ("fig7-ranking", "fig7-mean", "table3-time", "table3-energy", "table3-replans",
         "table4-gad", "table4-aad", "fig12-gad", "fig12-aad", "fig14", "table5", "fig16-gad",
         "fig16-aad")  # fmt: skip


def equal(name, mine, theirs):
    """Return True if two effects are equal, or differ by noise in the ends of a drawn interval."""
    if mine is None or theirs is None:
        return mine is theirs
    close = [math.isclose(a, b, rel_tol=1e-9, abs_tol=1e-12)
             for a, b in zip(mine, theirs, strict=True)]  # fmt: skip
    if name != "table4-aad-over-gad" and name.startswith(DRAWN):
        noise = 0.1 * (theirs[2] - theirs[1])
        close[1:3] = [abs(a - b) <= noise for a, b in zip(mine[1:3], theirs[1:3], strict=True)]
    return all(close)


def as_text(numbers):
    """Return an effect with its interval and n as text."""
    if numbers is None:
        return "no effect"
    return "{:+.6f} ({:+.6f} to {:+.6f}), n = {:,}".format(*numbers)


def main() -> int:
    """Recompute the claims, compare them with the report's, and print them.

    Return the exit code, which is 1 if a claim differs.
    """
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("export", type=Path, help="the paper's missions, a .parquet file")
    parser.add_argument("kernels", type=Path, help="summary of `mavfi kernels`, a .json file")
    asked = parser.parse_args()
    mine, theirs = (f(asked.export, asked.kernels) for f in (recomputed, of_mavfi))
    unequal = 0
    for (name, fate), (effect, told) in mine.items():
        other = theirs[name, fate]
        same = equal(name, effect, other[0]) and told == other[1]
        unequal += not same
        for numbers, verdict in ((effect, told), *(() if same else (other,))):
            mark = "" if same else "  UNEQUAL"
            print(f"{name:24}{fate:8}{as_text(numbers):56}{verdict}{mark}")
    claims = len({name for name, _ in mine})
    print(f"{claims} claims recomputed, {len(mine)} verdicts, {unequal} unequal")
    return int(unequal > 0)


if __name__ == "__main__":
    raise SystemExit(main())
