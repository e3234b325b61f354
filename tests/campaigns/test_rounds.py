"""Stratified campaigns: draws, weights, resumption, stopping, exports."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from mavfi_cli.analysis.flights import exported
from mavfi_cli.analysis.pairs import Flights
from mavfi_cli.analysis.summary import groups, summarise
from mavfi_cli.campaigns.begin import begin, opened, rounds_of, stopped
from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.campaigns.missions import Sampling
from mavfi_cli.campaigns.progress import Spectator
from mavfi_cli.campaigns.run import Options, fly_missing
from mavfi_cli.campaigns.specification import Keep, Stop
from mavfi_cli.campaigns.specification_file import parse_spec
from mavfi_cli.campaigns.strata import coarsened, stratum_of
from mavfi_cli.core.errors import ConfigError, RecordError, UnknownName
from mavfi_cli.paper.status import shown
from mavfi_cli.report.campaign import CampaignReport
from mavfi_cli.spec.fault import FaultConfig, InstructionConfig


def stratified(name, settings):
    head = f'name = "{name}"\nrepetitions = 50\nsampling = "stratified"\n'
    head += '[mission]\nworld = "fragile"\n[[setting]]\nname = "golden"\n'
    return parse_spec(head + settings, Path(f"{name}.toml"))


SPEC = stratified(
    "fragile",
    """[[setting]]
name = "FI"
site = "waypoint_x"
[[setting]]
name = "D&R"
site = "waypoint_x"
detector = "aad"
""",
)
NATIVE = stratified(
    "native",
    """[[setting]]
name = "FI"
level = "instruction"
stage = "planning"
""",
)


class Killed(Exception):
    pass


class Killer(Spectator):
    """Ends the campaign like a kill, after some missions."""

    def __init__(self, after):
        self.after = after

    def on_progress(self, progress):
        if progress.over >= self.after:
            raise Killed


def flown(spec, folder, options, spectator=None):
    """Fly a campaign of made-up missions, and return its draws and losses."""
    kept = replace(spec)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mavfi_cli.campaigns.begin.check_kinds", lambda _missions: None)
        with begin(kept, folder) as ledger:
            rounds = rounds_of(spec, ledger)
            fly_missing(ledger, options, spectator or Spectator(), spec.stop, rounds)
            return ledger.draws(), dict(ledger.fates())


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The folder of a campaign, with its draws and losses."""
    folder = tmp_path_factory.mktemp("strata") / "campaign"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(Path(__file__).parent))
        return folder, *flown(SPEC, folder, Options(jobs=2, keep=Keep.NONE, task="fake_task"))


@pytest.mark.slow
def test_draws_depend_on_neither_workers_nor_a_kill(whole, campaign):
    _, draws, fates = whole
    one = replace(campaign.options, jobs=1)
    with pytest.raises(Killed):
        flown(SPEC, campaign.folder, one, Killer(40))
    with Ledger(campaign.folder) as ledger:
        assert 0 < ledger.over() < ledger.planned()
    assert flown(SPEC, campaign.folder, one) == (draws, fates)


@pytest.mark.slow
def test_the_weights_of_a_round_add_up_and_harm_gets_more_missions(whole):
    _, draws, _ = whole
    bare = [draw for number, draw in draws.items() if number % 3 == 1]
    for number in (0, 1):
        mine = [draw for draw in bare if draw.round == number]
        assert sum(draw.weight for draw in mine) == pytest.approx(len(mine)) == 25
    weights = {draw.stratum: draw.weight for draw in bare if draw.round == 1}
    assert all(weight < 1.0 for name, weight in weights.items() if name.startswith("exponent"))
    assert any(weight > 1.0 for name, weight in weights.items() if name.startswith("mantissa"))


def test_detectors_fly_the_same_faults(whole):
    folder, draws, _ = whole
    with Ledger(folder) as ledger:
        configs = {result.number: result.mission.config for result in ledger.results()}
        (comparison,) = summarise(ledger, groups(ledger)).protection
    for number in range(1, len(configs), 3):
        bare, watched = configs[number], configs[number + 1]
        assert replace(watched, detector=None) == bare
        assert draws[number][1:4] == draws[number + 1][1:4]
        assert bare.seed == configs[number - 1].seed
    assert (comparison.success.pairs, comparison.success.difference) == (50, 0.0)


def test_status_says_so_and_gives_an_effective_number(whole):
    folder, *_ = whole
    with Ledger(folder) as ledger:
        report, (table, _) = CampaignReport.of(ledger), shown(ledger)
        with pytest.raises(ConfigError, match="have weights"):
            Flights.of(exported(ledger))
    assert report.summary.sampling == "stratified"
    assert "stratified sample" in "\n".join(report.lines())
    assert "stratified sample" in "\n".join(table.notes)
    golden, struck, _ = report.summary.cells
    assert golden.success.effective == golden.success.total
    assert struck.success.total == 50
    assert 30 < struck.success.effective < 100  # small strata doubt what they hold
    assert struck.every.share == pytest.approx(1.0 - 11 / 128, abs=0.05)


def test_an_export_keeps_the_weights_and_one_without_them_is_refused(whole, tmp_path):
    folder, *_ = whole
    with Ledger(folder) as ledger:
        table, summary = exported(ledger), summarise(ledger, groups(ledger))
    path = tmp_path / "export.parquet"
    pq.write_table(table, path)
    with opened(path) as ledger:
        assert [cell.success for cell in summarise(ledger, groups(ledger)).cells] == [
            cell.success for cell in summary.cells
        ]
    lost = table.drop_columns(["weight"])
    for merged in (lost, lost.replace_schema_metadata(None), table.drop_columns(["stratum"])):
        pq.write_table(merged, path)
        if "weight" in merged.column_names:  # all that is left says that the sample is stratified
            merged = merged.drop_columns(["weight"])
            pq.write_table(merged, path)
        with pytest.raises(RecordError, match="must have a weight above 0"), opened(path):
            pass


@pytest.mark.slow
def test_a_rule_stops_settings_by_the_interval_of_weights(campaign):
    spec = replace(SPEC, repetitions=60, stop=Stop(margin=0.12, batch=20))
    flown(spec, campaign.folder, campaign.options)
    with Ledger(campaign.folder) as ledger:
        cells = {cell.labels["setting"]: cell for cell in summarise(ledger, groups(ledger)).cells}
        assert len(stopped(ledger)) == 3
    assert sum(cells["golden"].outcomes.values()) == 20
    success = cells["FI"].success
    assert (success.high - success.low) / 2 <= 0.12
    assert 20 < success.total < 60


@pytest.mark.slow
def test_later_requests_of_a_plan_are_a_stratum_of_their_own(campaign):
    draws, fates = flown(NATIVE, campaign.folder, campaign.options)
    lost = {number for number, (outcome, _) in fates.items() if outcome == "collision"}
    assert lost == {n for n, draw in draws.items() if draw.stratum == "planner, later request"}
    with Ledger(campaign.folder) as ledger:
        _, struck = summarise(ledger, groups(ledger)).cells
    # Of 1, 2 or 3 requests, each as often, so many are later ones.
    assert 1.0 - struck.every.share == pytest.approx((1 / 2 + 2 / 3) / 3, abs=0.06)


def test_another_sampling_has_another_name_and_text():
    uniform = replace(SPEC, sampling=Sampling.UNIFORM)
    assert "sampling" not in uniform.to_toml()
    assert uniform.sampled(Sampling.STRATIFIED).name == "fragile-stratified"
    assert parse_spec(SPEC.to_toml(), Path("again.toml")) == SPEC
    assert uniform.differences(SPEC) == ["sampling uniform there, stratified here"]
    with pytest.raises(UnknownName, match="sampling"):
        parse_spec('sampling = "odd"', Path("odd.toml"))


def test_strata_of_faults():
    places = Counter(stratum_of(FaultConfig(target="waypoint_x", seed=s)) for s in range(1, 2001))
    fields = Counter()
    for (name, half, state, moment), count in places.items():
        assert state == "waypoint_x"
        assert moment in ("early", "midway", "late")
        fields[name, half] += count
    assert fields["mantissa", "upper half"] == pytest.approx(2000 * 26 / 64, rel=0.1)
    assert fields["exponent", "upper half"] == pytest.approx(2000 * 6 / 64, rel=0.25)
    assert stratum_of(FaultConfig(target="process.octomap")) == ()
    native = InstructionConfig(target="planner", seed=5)
    assert stratum_of(native) == ("planner", "any request")
    assert stratum_of(native, 1) == ("planner", "first request")


def test_small_strata_are_merged_from_the_finest_part_on():
    strata = [("a", "x")] * 6 + [("a", "y")] + [("b", "x")] * 2 + [("c",)]
    assert coarsened(strata, 0.5) == {(), ("a", "x")}
    assert coarsened(strata, 0.2) == {(), ("a", "x"), ("b", "x")}
