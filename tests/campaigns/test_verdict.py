"""What the end of a mission's process means."""

import json

import pytest

from mavfi_cli.campaigns.workers import AttemptEnd
from mavfi_cli.core.errors import Interrupted
from mavfi_cli.spec.mission import MissionConfig


def test_a_mission_that_was_interrupted_before_its_record_does_not_count(tmp_path):
    last_words = {"error": Interrupted.__name__, "text": "interrupted"}
    verdict = AttemptEnd(number=1, exit=0, report=last_words).judge(tmp_path, MissionConfig(), 60.0)
    assert (verdict.state, verdict.reason) == (None, "interrupted")


@pytest.mark.parametrize(("stage", "doubtful"), [("planning", True), ("process", False)])
def test_a_killed_node_is_a_doubt_unless_the_fault_killed_it(tmp_path, stage, doubtful):
    run = tmp_path / "run"
    run.mkdir()
    nodes = {"planner": {"crashes": [{"how": "killed by SIGKILL", "stamp_s": 9.0}]}}
    result = {"outcome": "success", "reason": "", "nodes": nodes, "fault": {"stage": stage}}
    (run / "result.json").write_text(json.dumps(result))
    ended = AttemptEnd(number=1, exit=0, report={"folder": "run"})
    assert ended.judge(tmp_path, MissionConfig(), 60.0).doubtful is doubtful
