"""Settling claims: what is flown, how each claim is decided, and lists that cannot grow."""

import dataclasses
import json

import pyarrow.parquet as pq
import pytest

from mavfi_cli.analysis.flights import SETTLING, exported
from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.campaigns.progress import Spectator
from mavfi_cli.campaigns.run import Options
from mavfi_cli.core.errors import ConfigError
from mavfi_cli.paper import flying, settling
from mavfi_cli.paper.claims import judged
from mavfi_cli.paper.items import FlightsPlan, items_named
from mavfi_cli.paper.settling import require_settleable, settle
from mavfi_cli.paper.sources import Evidence
from mavfi_cli.paper.verdicts import SettledClaim, Settling, Verdict

pytestmark = pytest.mark.usefixtures("no_vehicle")
TASK = Options(jobs=2, task="fake_task")
SCALE = 0.05


class Notes(Spectator):
    def __init__(self):
        self.lines = []

    def on_note(self, text):
        self.lines.append(text)


def settled(plan, spectator, hours):
    with flying.opened(plan) as ledger:
        return settle(plan, ledger, TASK, spectator, hours)


@pytest.mark.slow
def test_missions_are_flown_until_the_claim_is_decided(tmp_path, monkeypatch):
    """No made-up fault does harm, which contradicts that fields of a number differ in harm."""
    plan = FlightsPlan(items=items_named(["fig9"]), stack="mavbench", scale=SCALE, out=tmp_path)
    flying.reproduce(plan, TASK, Spectator(), lambda _: None)
    (line,) = settled(plan, Notes(), 1e-9)  # too short a time: it flies nothing
    assert line.startswith("fig9-fields: cannot tell; ")
    monkeypatch.setattr(settling, "BATCH", 150)
    with Ledger(plan.folder) as ledger:
        before = ledger.over()
    notes = Notes()
    lines = settled(plan, notes, None)
    assert [line.partition(";")[0] for line in lines] == ["fig9-fields: contradicted"]
    assert "the effect lies between" in lines[0]
    assert notes.lines[0] == "1 claims are undecided:"
    assert "fig9-fields: " in notes.lines[1]
    assert "if the effect stays" in notes.lines[1]
    with Ledger(plan.folder) as ledger:
        added = ledger.over() - before
        stored = Settling.of(ledger.meta(SETTLING))
        table = exported(ledger)
    own = stored.claims["fig9-fields"]
    assert (own.missions, own.verdict) == (added, "contradicted")
    assert own.looks == stored.looks
    assert settled(plan, Notes(), 0.001) == []  # it is decided
    pq.write_table(table, tmp_path / "settled.parquet")
    evidence = Evidence.gather([tmp_path / "settled.parquet"])
    claims = judged({"mavbench": evidence.flights("mavbench")}, {}, evidence.settled)
    (judgement,) = (
        next(iter(entry.judgements["mavbench"].values()))
        for entry in claims
        if entry.claim.name == "fig9-fields"
    )
    assert judgement.verdict is Verdict.CONTRADICTED
    assert judgement.bounds is not None
    assert "missions were added for it" in judgement.history


def test_a_list_that_cannot_grow_is_refused(tmp_path):
    plan = FlightsPlan(items=items_named(["fig9"]), stack="mavbench", out=tmp_path / "x.parquet")
    with pytest.raises(ConfigError, match="cannot add missions to an export"):
        require_settleable(plan)
    model = dataclasses.replace(plan, items=items_named(["fig15"]), out=tmp_path)
    with pytest.raises(ConfigError, match="must fly missions"):
        require_settleable(model)


def test_a_damaged_record_of_settling_is_refused():
    stored = Settling(looks=2, claims={"a": SettledClaim(looks=1, missions=3)})
    assert Settling.of(stored.to_json()) == stored
    assert Settling.of(json.loads(stored.to_json())) == stored
    assert Settling.of(None) is None
    for damaged in ({"looks": "many"}, "{", "[" * 100_000, "[]"):
        with pytest.raises(ConfigError):
            Settling.of(damaged)


def test_hours_need_settle(mavfi):
    assert "--hours needs --settle" in mavfi("reproduce", "fig9", "--hours", "1").stderr
