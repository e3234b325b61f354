"""What the end of a mission's process means."""

from mavfi_cli.campaign.workers import AttemptEnd, judge
from mavfi_cli.core.errors import Interrupted


def test_a_mission_that_was_interrupted_before_its_record_does_not_count(tmp_path):
    last_words = {"error": Interrupted.__name__, "text": "interrupted"}
    verdict = judge(AttemptEnd(number=1, exit=0, report=last_words), tmp_path, {}, 60.0)
    assert (verdict.state, verdict.reason) == (None, "interrupted")
