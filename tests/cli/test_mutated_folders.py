"""Folders of somebody else's with changed contents: commands read them, or refuse in one line."""

import contextlib
import json
import random
import shutil
import sqlite3
import zlib

import pytest
from missions import SHORT_WAY

from mavfi_cli.campaigns.ledger import LEDGER, Ledger
from mavfi_cli.core.errors import RecordError
from mavfi_cli.mission import run as run_module
from mavfi_cli.mission.run_folder import RESULT, load_run

pytest.importorskip("rerun")
pytest.importorskip("mcap")
SPEC = f"""
repetitions = 1
keep = "all"
{SHORT_WAY}
world = "farm"
stack = "hardened"
seed = 5
[[setting]]
name = "golden"
[[setting]]
name = "faulty"
stage = "planning"
"""
RUN = [
    "show RUN --events --picture flight.svg",
    "replay RUN",
    "replay RUN --without-fault",
    "view RUN --save view.rrd",
    "view RUN --save view.mcap --layout layout.json",
]
CAMPAIGN = [
    "campaign status DIR",
    "campaign status DIR --full --quality --failures --overhead",
    "campaign report DIR",
    "campaign draw DIR --output pair.svg",
    "campaign export DIR -",
    "campaign plan DIR",
    "report DIR -o page.html",
    "replay DIR --mission 1",
]
NOTES = ("note: ", "warning: ", "flying ", "no depth ")  # lines that are no errors
ESCAPE = "\x1b]0;theirs\x07\r\x85\u2028"
VALUES = (
    None, True, -1, 0, 3, 2**70, 1e308, -1e308, 1e-320, float("nan"), float("inf"), "", "theirs",
    ESCAPE, "x" * 10_000, "\udce9", [], {}, [None], [[1]], {"": 1}, [ESCAPE], {ESCAPE: ESCAPE},
)  # fmt: skip
CELLS = (None, 5, -1.5, 1e308, "theirs", ESCAPE, "", b"\x00\xff", "[1]", "{}")


@pytest.fixture(scope="module")
def flown(mavfi, tmp_path_factory):
    """A campaign of a golden and a faulty flight, whose run folders are kept."""
    folder = tmp_path_factory.mktemp("flown")
    (folder / "theirs.toml").write_text(SPEC)
    done = mavfi("campaign", "run", "theirs.toml", "--out", "theirs", "--quiet", cwd=folder)
    assert done.returncode == 0, done.stderr
    theirs = folder / "theirs"
    with Ledger(theirs) as ledger:
        golden, faulty = (each.path for each in ledger.results([0, 1]))
    shutil.copytree(golden, faulty / "golden")
    return theirs, faulty.relative_to(theirs)


@pytest.fixture
def command(flown, command_line, monkeypatch):
    """Run a command that flies nothing; what it printed."""

    def no_flight(*_arguments, **_options):
        return load_run(flown[0] / flown[1])

    def no_recorder(*_arguments, **_options):
        raise RecordError("not flown")

    monkeypatch.setattr(run_module, "fly_to_end", no_flight)
    monkeypatch.setattr(run_module, "watch_again", no_recorder)

    def run(line):
        code, out, err = command_line(*line)
        assert code in (0, 1, 2)
        errors = [each for each in err.splitlines() if not each.startswith(NOTES)]
        assert len(errors) == (code != 0 and not out), (code, out, err)
        assert all(each.startswith("error: ") for each in errors)
        text = out + err
        assert all(each.isprintable() for each in text.split("\n")), repr(text)

    return run


def _changed(value, rng):
    """A copy of a JSON value in which one value, chosen evenly by depth, is another."""
    if isinstance(value, dict | list) and value and rng.random() < 0.9:
        copy = value.copy()
        place = rng.choice(list(value) if isinstance(value, dict) else range(len(value)))
        if rng.random() < 0.1:
            del copy[place]
        else:
            copy[place] = _changed(value[place], rng)
        return copy
    return rng.choice(VALUES)


def _change_run(folder, rng):
    path = folder / RESULT
    text = json.dumps(_changed(json.loads(path.read_text()), rng))
    path.write_text(text, errors="surrogatepass")


def _change_ledger(folder, rng):
    with contextlib.closing(sqlite3.connect(folder / LEDGER)) as database, database:
        table = rng.choice(["meta", "cells", "missions", "results", "records"])
        names = [row[1] for row in database.execute(f"PRAGMA table_info({table})")]
        key, name = names[0], rng.choice(names)
        query = f"SELECT {key}, {name} FROM {table}"
        number, old = rng.choice(database.execute(query).fetchall())
        with contextlib.suppress(sqlite3.IntegrityError):
            change = f"UPDATE {table} SET {name} = ? WHERE {key} = ?"
            database.execute(change, (_cell(old, rng), number))


def _cell(old, rng):
    """Another value of a cell, which may be a text, a number, JSON, or compressed JSON."""
    packed = isinstance(old, bytes)
    text = zlib.decompress(old).decode() if packed else old
    if not isinstance(text, str) or text[:1] not in ("{", "["):
        return rng.choice(CELLS)
    changed = json.dumps(_changed(json.loads(text), rng))
    return zlib.compress(changed.encode()) if packed else changed


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("line", [*RUN, *CAMPAIGN])
def test_a_changed_folder_is_read_or_refused_in_one_line(line, seed, flown, command, tmp_path):
    theirs, run = flown
    folder, rng = tmp_path / "copy", random.Random(f"{line} {seed}")
    shutil.copytree(theirs, folder)
    for _ in range(rng.randint(1, 3)):
        if line in RUN or rng.random() < 0.3:
            _change_run(folder / run, rng)
        if line in CAMPAIGN:
            _change_ledger(folder, rng)
    words = {"RUN": folder / run, "DIR": folder}
    command([words.get(word, word) for word in line.split()])


@pytest.mark.parametrize("line", [*RUN, *CAMPAIGN])
def test_no_text_of_a_folder_commands_the_terminal(line, flown, command, tmp_path):
    theirs, run = flown
    folder = tmp_path / "copy"
    shutil.copytree(theirs, folder)
    for path in folder.rglob(RESULT):
        result = json.loads(path.read_text())
        path.write_text(json.dumps(result | {"reason": ESCAPE, "outcome": f"crash{ESCAPE}"}))
    with contextlib.closing(sqlite3.connect(folder / LEDGER)) as database, database:
        database.execute("UPDATE results SET reason = ?, outcome = ?", (ESCAPE, f"crash{ESCAPE}"))
        database.execute("UPDATE meta SET value = value || ? WHERE key = 'name'", (ESCAPE,))
        for cell, labels in database.execute("SELECT cell, labels FROM cells").fetchall():
            labels = json.dumps({name: f"{v}{ESCAPE}" for name, v in json.loads(labels).items()})
            database.execute("UPDATE cells SET labels = ? WHERE cell = ?", (labels, cell))
    words = {"RUN": folder / run, "DIR": folder}
    command([words.get(word, word) for word in line.split()])
