"""Kill a running campaign's processes at random, and run it again until it is complete.

Also the stress test of benchmarks/campaign_kills.py; needs nothing of pytest.
"""

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.core.fork_server import GUARD, SERVER, WORKER

RUNNER, VEHICLE = "runner", "vehicle"
VICTIMS = (RUNNER, SERVER, GUARD, WORKER)
_MARK = "MAVFI_TEST_CAMPAIGN"


def marked(mark):
    """An environment by which the processes of one campaign, and no others, are found again."""
    return {**os.environ, _MARK: mark}


def processes(mark):
    """Process ids by kind, of everything that the runner of this mark has started."""
    found = {}
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            environment = (entry / "environ").read_bytes().split(b"\0")
            name = (entry / "comm").read_text().strip()
            line = (entry / "cmdline").read_bytes()
        except OSError:
            continue
        if f"{_MARK}={mark}".encode() not in environment:
            continue  # also of a zombie, which has none
        kind = VEHICLE if b"sitl" in line.split(b"\0") else name
        found.setdefault(kind, []).append(int(entry.name))
    return found


def kill_one(runner, mark, victim):
    """Kill one process of that kind, if missions are flying and there is one now."""
    found = processes(mark)
    if WORKER not in found:
        return False
    if victim == RUNNER:
        runner.kill()
        return True
    for pid in found.get(victim, [])[:1]:
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            continue
        return True
    return False


def complete_with_kills(start, mark, kills, seed, pause_s, victims=VICTIMS):
    """Run a campaign to its end in spite of so many kills; how often each kind was hit.

    Args:
        start: starts the runner with the environment of the mark, a subprocess.Popen.
        kills: when there were so many, the runner is left in peace.
        pause_s: at most between two kills.
    """
    rng = random.Random(seed)
    hits = Counter()
    while True:
        runner = start()
        while runner.poll() is None:
            if hits.total() >= kills:
                runner.wait()
                break
            time.sleep(rng.uniform(0.0, pause_s))
            victim = rng.choice(victims)
            if runner.poll() is None and kill_one(runner, mark, victim):
                hits[victim] += 1
        if runner.wait() == 0:
            return hits


def results_of(folder):
    """What must come out the same: everything but what a clock measured."""
    found = []
    with Ledger(folder) as ledger:
        for each in ledger.results():
            result = {k: v for k, v in each.result.items() if k != "host"}
            found.append((each.number, each.outcome, json.dumps(result, sort_keys=True)))
    return found


def start_fake(folder, count):
    """Start the runner above; its mark is its folder."""
    line = [sys.executable, __file__, str(folder), str(count), "fake_task"]
    return subprocess.Popen(line, stderr=subprocess.DEVNULL, env=marked(str(folder)))


if __name__ == "__main__":  # the runner of the tests: a list of missions without flights
    from mavfi_cli.campaigns.missions import PlannedMission
    from mavfi_cli.campaigns.run import Options, run_campaign
    from mavfi_cli.campaigns.workers import CampaignStopped
    from mavfi_cli.spec.mission import MissionConfig

    folder, count, task = Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
    missions = [
        PlannedMission(config=MissionConfig(world="sleep:0.2", seed=seed)) for seed in range(count)
    ]
    try:
        run_campaign(missions, folder, Options(jobs=2, task=task)).close()
    except CampaignStopped as error:
        sys.exit(str(error))
