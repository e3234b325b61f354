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

from mavfi_cli.campaign.ledger import Ledger

VICTIMS = ("runner", "template", "slot", "mission", "vehicle")


def descendants(pid):
    """Every living process that another one of them started, with its generation from 1."""
    parents = {}
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = entry.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if fields[0] != "Z":
            parents[int(entry.parent.name)] = int(fields[1])
    found = {}
    generation, layer = 1, {pid}
    while layer:
        layer = {child for child, parent in parents.items() if parent in layer}
        found.update(dict.fromkeys(layer, generation))
        generation += 1
    return found


def kill_one(runner, victim):
    """Kill one process of that kind, if missions are flying and there is one now."""
    generation = VICTIMS.index(victim)
    found = descendants(runner.pid)
    if VICTIMS.index("mission") not in found.values():
        return False
    if generation == 0:
        runner.kill()
        return True
    chosen = sorted(pid for pid, g in found.items() if g == generation)
    for pid in chosen[:1]:
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            continue
        return True
    return False


def complete_with_kills(start, kills, seed, pause_s):
    """Run a campaign to its end in spite of so many kills; how often each kind was hit.

    Args:
        start: starts the runner, a subprocess.Popen.
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
            victim = rng.choice(VICTIMS)
            if runner.poll() is None and kill_one(runner, victim):
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


if __name__ == "__main__":  # the runner of the tests: a list of missions without flights
    from mavfi_cli.campaign.missions import PlannedMission
    from mavfi_cli.campaign.run import Options, run_campaign
    from mavfi_cli.campaign.verdict import CampaignStopped
    from mavfi_cli.mission.config import MissionConfig

    folder, count, task = Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
    missions = [
        PlannedMission(config=MissionConfig(world="sleep:0.2", seed=seed)) for seed in range(count)
    ]
    try:
        run_campaign(missions, folder, Options(jobs=2, task=task)).close()
    except CampaignStopped as error:
        sys.exit(str(error))


def start_fake(folder, count):
    """Start the runner above."""
    line = [sys.executable, __file__, str(folder), str(count), "fake_task"]
    return subprocess.Popen(line, stderr=subprocess.DEVNULL)
