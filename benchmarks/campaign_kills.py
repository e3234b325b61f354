"""50 random kills of a campaign of real flights: nothing lost, nothing doubled, the same results.

    python benchmarks/campaign_kills.py [--kills 50] [--missions 60] [--seed 1]

Kills the runner, the process that forks the slots, slots, missions and their simulated vehicles,
and runs the campaign again until it is complete.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "campaign_missions"))

from killing import complete_with_kills, marked, results_of
from missions import MAVFI

SPEC = """
name = "kills"
repetitions = {repetitions}
[mission]
start = [2.0, 2.0, 0.0]
goal = [20.0, 16.0, 5.0]
[factors]
world = "farm"
[[setting]]
name = "golden"
[[setting]]
name = "FI"
stage = "control"
[[setting]]
name = "native"
level = "instruction"
stage = "planning"
"""


def start(spec: Path, folder: Path) -> subprocess.Popen[bytes]:
    """Begin the campaign, or go on with it."""
    line = [*MAVFI, "campaign", "run", str(spec), "--out", str(folder)]
    return subprocess.Popen([*line, "--quiet"], stdout=subprocess.DEVNULL, env=marked(str(folder)))


def main() -> None:
    """Fly it twice, once with kills, and compare."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--missions", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        home = Path(name)
        spec = home / "kills.toml"
        spec.write_text(SPEC.format(repetitions=max(1, given.missions // 3)))
        if start(spec, home / "undisturbed").wait() != 0:
            raise SystemExit("the undisturbed campaign failed")
        disturbed = home / "disturbed"
        hits = complete_with_kills(
            partial(start, spec, disturbed), str(disturbed), given.kills, given.seed, pause_s=4.0
        )
        same = results_of(disturbed) == results_of(home / "undisturbed")
        count = len(results_of(disturbed))
    print(f"{hits.total()} kills: {', '.join(f'{k} {v}' for k, v in sorted(hits.items()))}")
    print(f"{count} missions, results {'the same' if same else 'DIFFERENT'}")
    if not same or hits.total() < given.kills:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
