"""Kills a campaign of real flights 50 times, and checks that no result is lost or different.

    python benchmarks/campaign_kills.py [--kills 50] [--missions 60] [--seed 1]

Kills the runner, the server that forks the workers, their guards and the workers themselves at
random times, and runs the campaign again until it is complete. The results must equal those of an
undisturbed campaign.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "campaign"))

from killing import complete_with_kills, marked, results_of
from missions import MAVFI

Result = tuple[int, str, str]  # number, outcome, record as JSON

SPEC = """
name = "kills"
repetitions = {repetitions}
[mission]
start = [2.0, 2.0, 0.0]
goal = [20.0, 16.0, 5.0]
stack = "hardened"
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
    """Start the campaign in a folder or resume it, and return the process that runs it."""
    line = [*MAVFI, "campaign", "run", str(spec), "--out", str(folder)]
    return subprocess.Popen([*line, "--quiet"], stdout=subprocess.DEVNULL, env=marked(str(folder)))


def differences(expected: list[Result], found: list[Result]) -> Iterator[str]:
    """Yield one line for each mission whose results differ, with the differing keys of its record.

    `expected` has the results of the undisturbed campaign, and `found` those of the disturbed one.
    """
    one, other = ({number: rest for number, *rest in each} for each in (expected, found))
    for number in sorted({*one, *other}):
        if number not in one or number not in other:
            yield f"mission {number}: only {'undisturbed' if number in one else 'disturbed'}"
            continue
        (outcome, text), (outcome_other, text_other) = one[number], other[number]
        if (outcome, text) != (outcome_other, text_other):
            records = json.loads(text), json.loads(text_other)
            keys = [
                key
                for key in sorted({*records[0], *records[1]})
                if records[0].get(key) != records[1].get(key)
            ]
            yield (
                f"mission {number}: {outcome}, disturbed {outcome_other}"
                f" ({records[1].get('reason')}); differs in {', '.join(keys)}"
            )


def main() -> None:
    """Run the campaign without and with kills, and compare the results."""
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
        expected, found = results_of(home / "undisturbed"), results_of(disturbed)
    differing = list(differences(expected, found))
    print(f"{hits.total()} kills: {', '.join(f'{k} {v}' for k, v in sorted(hits.items()))}")
    print(f"{len(found)} missions, results {'DIFFERENT' if differing else 'the same'}")
    print("\n".join(differing))
    if differing or hits.total() < given.kills:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
