"""`mavfi campaign` as a user calls it: a short campaign, and every bad input in one line."""

import csv
import json
import re
import sqlite3
import subprocess
import sys
import tomllib
import xml.etree.ElementTree as ET

import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner
from missions import SHORT_WAY

from mavfi_cli.campaigns.ledger import LEDGER
from mavfi_cli.cli import campaign as command

SPEC = f"""
name = "short"
repetitions = 2
keep = "all"
{SHORT_WAY}[factors]
world = "farm"
[[setting]]
name = "golden"
[[setting]]
name = "FI"
site = "waypoint_position"
together = true
field = "mantissa"
"""


def written(folder, text=SPEC, name="short.toml"):
    path = folder / name
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def flown(mavfi, tmp_path_factory):
    """The folder of the short campaign, flown, and the run that flew it."""
    home = tmp_path_factory.mktemp("home")
    run = mavfi("campaign", "run", written(home), "--json", cwd=home)
    assert run.returncode == 0, run.stderr
    return home / "campaigns" / "short", run


@pytest.mark.slow
def test_a_campaign_is_flown_and_summed_up(flown):
    folder, run = flown
    summary = json.loads(run.stdout)
    assert (summary["name"], summary["missions"], summary["missing"]) == ("short", 4, 0)
    golden, faulty = summary["cells"]
    assert golden["labels"] == {"setting": "golden", "world": "farm"}
    assert golden["success"]["count"] == golden["success"]["total"] == 2
    assert faulty["success"]["total"] + faulty["inactive"]["total"] == 2
    assert golden["metrics"]["flight_time_s"]["value"] > 2.0
    assert "4/4 missions" in run.stderr
    end = r"4 missions in \d+:\d\d min, \d+ an hour, \d+\.\d % .*"
    assert re.search(f"^{end}$", run.stderr, re.MULTILINE)
    assert (folder / "campaign.toml").read_text().startswith('name = "short"\n')
    assert len(list((folder / "runs").glob("*/result.json"))) == 4


@pytest.mark.slow
def test_whole_flies_every_mission_from_its_start(flown, mavfi, tmp_path):
    folder, _ = flown
    run = mavfi("campaign", "run", written(tmp_path), "--whole", "--quiet", cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    shared, whole = (
        [json.loads(file.read_text()) for file in sorted(place.glob("runs/*/result.json"))]
        for place in (folder, tmp_path / "campaigns" / "short")
    )
    hosts = [[result.pop("host") for result in results] for results in (shared, whole)]
    assert [any("forked_s" in host for host in own) for own in hosts] == [True, False]
    assert whole == shared


def test_a_complete_campaign_flies_nothing_again(flown, mavfi):
    folder, _ = flown
    for what in ([folder], [folder, "--missing-only"]):
        run = mavfi("campaign", "run", *what, "--quiet")
        assert (run.returncode, run.stderr) == (0, "")
        assert run.stdout.startswith("short: 4 of 4 missions\n")
    assert mavfi("campaign", "status", folder).stdout == run.stdout


def test_a_campaign_is_read_by_the_name_that_ran_it(flown, mavfi, tmp_path):
    folder, _ = flown
    home = folder.parent.parent
    status = mavfi("campaign", "status", "short.toml", cwd=home)
    assert status.stdout == mavfi("campaign", "status", folder).stdout != ""
    (tmp_path / "campaigns").mkdir()
    (tmp_path / "campaigns" / "fig8").symlink_to(folder)
    for arguments in (("status", "fig8"), ("export", "fig8", "table.csv"),
                      ("draw", "fig8", "--output", "pair.svg")):  # fmt: skip
        done = mavfi("campaign", *arguments, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        assert done.stdout


@pytest.mark.parametrize("name", ["table.csv", "table.parquet"])
def test_export_has_a_row_a_mission(flown, mavfi, tmp_path, name):
    folder, _ = flown
    run = mavfi("campaign", "export", folder, tmp_path / name)
    assert run.stdout == f"4 missions in {tmp_path / name}\n"
    if name.endswith(".csv"):
        rows = list(csv.DictReader((tmp_path / name).read_text().splitlines()))
    else:
        rows = pq.read_table(tmp_path / name).to_pylist()
    assert [int(row["number"]) for row in rows] == [0, 1, 2, 3]
    assert [row["label_setting"] for row in rows] == ["golden", "FI"] * 2
    assert {row["outcome"] for row in rows[::2]} == {"success"}
    assert [int(row["seed"]) for row in rows] == [1, 1, 2, 2]
    recorded = json.loads((folder / "runs" / "000001-farm-1" / "fault.json").read_text())
    (strike,) = recorded["strikes"]
    assert rows[1]["struck_state"] == "waypoint_x;waypoint_y;waypoint_z"
    assert rows[1]["struck_before"] == ";".join(str(each["before"]) for each in strike["changes"])
    assert float(rows[1]["strike_s"]) == strike["stamp_s"]
    assert rows[1]["strike_phase"] == strike["phase"] == "flying"
    assert rows[1]["activation"] == recorded["activation"]["activation"]
    assert {row["struck_state"] or None for row in rows[::2]} == {None}  # golden


def test_export_to_stdout_is_the_csv_file(flown, mavfi, tmp_path):
    folder, _ = flown
    mavfi("campaign", "export", folder, tmp_path / "table.csv")
    run = mavfi("campaign", "export", folder, "-", cwd=tmp_path)
    assert run.stdout == (tmp_path / "table.csv").read_text()
    assert [each.name for each in tmp_path.iterdir()] == ["table.csv"]
    refused = mavfi("campaign", "export", folder, tmp_path / "table.xls")
    assert ".parquet or .csv" in refused.stderr


@pytest.mark.parametrize(("chosen", "seed"), [((), 1), (("--pair", "3"), 2)])
def test_a_pair_is_drawn(flown, mavfi, tmp_path, chosen, seed):
    """Neither of the two faults costs time, so the first pair is the default."""
    folder, _ = flown
    picture = tmp_path / "pair.svg"
    run = mavfi("campaign", "draw", folder, *chosen, "--output", picture)
    assert run.returncode == 0, run.stderr
    place, title, golden, faulty, written_to = run.stdout.splitlines()
    assert place == f"farm, seed {seed}"
    assert re.match("fault: .*mantissa .* waypoint position", title)
    assert re.fullmatch(rf"  golden: success, \d+\.\d s  {folder}/runs/00000\d-farm-{seed}", golden)
    assert faulty.startswith("  FI: success, ")
    assert written_to == f"Picture  {picture}"
    ids = {each.get("id") for each in ET.parse(picture).iter("{http://www.w3.org/2000/svg}g")}
    assert {"flight-0-0", "flight-0-1"} <= ids


def test_what_was_drawn_in_json(flown, mavfi, tmp_path):
    folder, _ = flown
    run = mavfi("campaign", "draw", folder, "--output", tmp_path / "pair.svg", "--json")
    told = json.loads(run.stdout)
    (panel,) = told["panels"]
    assert [each["name"] for each in panel["flights"]] == ["golden", "FI"]
    assert panel["flights"][0]["path"] == str(folder / "runs" / "000000-farm-1")
    assert told["absent"] == []
    assert told["picture"] == str(tmp_path / "pair.svg")


def test_a_changed_specification_shows_the_difference(flown, mavfi, tmp_path):
    folder, _ = flown
    changed = written(tmp_path, SPEC.replace("mantissa", "exponent"))
    run = mavfi("campaign", "run", changed, "--out", folder)
    assert run.returncode == 1
    (line,) = run.stderr.splitlines()
    assert line.startswith(f"error: {folder}: ")
    assert "field mantissa there, exponent here; " in line
    assert re.search("4 missions there, 4 here, .* 2 are new, and 2 are gone; ", line)


def test_append_is_recommended_where_it_is_enough(flown, mavfi, tmp_path):
    folder, _ = flown
    more = written(tmp_path, SPEC.replace("repetitions = 2", "repetitions = 3"))
    line = mavfi("campaign", "run", more, "--out", folder).stderr
    assert "repetitions 2 there, 3 here; 4 missions there, 6 here" in line
    assert re.search("2 are new; --append ", line)
    fewer = written(tmp_path, SPEC.replace("repetitions = 2", "repetitions = 1"))
    line = mavfi("campaign", "run", fewer, "--out", folder).stderr
    assert re.search("4 missions there, 2 here, .* 0 are new, and 2 are gone", line)
    assert "--append" not in line


@pytest.fixture
def refused(mavfi, tmp_path):
    """Run a command that must end with one line on stderr and leave nothing; the line."""

    def run(*arguments):
        before = sorted(tmp_path.iterdir())
        done = mavfi("campaign", *arguments, cwd=tmp_path)
        code = (
            2 if done.stderr.startswith(("error: unknown ", "error: --", "error: Invalid")) else 1
        )
        assert (done.returncode, done.stdout) == (code, ""), done.stderr
        (line,) = done.stderr.splitlines()
        assert sorted(tmp_path.iterdir()) == before
        return line.removeprefix("error: ")

    return run


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ('world = "farm"', 'world = "fram"', "'fram'.* 'farm'"),
        ('world = "farm"', 'wrold = "farm"', r"factors\.wrold: .* 'world'"),
        ('world = "farm"', "world = []", r"factors\.world: .* at least one"),
        ("repetitions = 2", "repetitions = 0", "repetitions: .* at least 1, got 0"),
        ("waypoint_position", "waypoint_postion", "mean 'waypoint_position'"),
        ('field = "mantissa"', 'field = "mantisa"', "mean 'mantissa'"),
        ('world = "farm"', 'planner = "rtt"', "'rtt'.* 'rrt'"),
        ('world = "farm"', 'vehicle = "sola"', "'sola'.* 'solo'"),
        ('world = "farm"', 'detector = "gda"', "'gda'.* 'gad'"),
        ('world = "farm"', 'platform = "x68"', "'x68'.* 'x86'"),
    ],
)
def test_a_bad_specification_gets_one_line_and_flies_nothing(refused, tmp_path, old, new, problem):
    assert old in SPEC
    spec = written(tmp_path, SPEC.replace(old, new))
    assert re.search(problem, refused("run", spec))
    assert re.search(problem, refused("plan", spec))


def test_a_refused_setting_is_named_among_many(refused, tmp_path):
    spec = SPEC.replace('site = "waypoint_position"', 'site = ["command", "future_collision_seq"]')
    spec = spec.replace("mantissa", "exponent").replace('"command"', '"command_yaw"')
    line = refused("run", written(tmp_path, spec))
    assert "int32 has no field 'exponent'" in line
    assert " (in setting=FI world=farm " in line
    assert "site=future_collision_seq" in line


def test_what_does_not_exist_gets_one_line(refused, tmp_path):
    for command_line in (("run",), ("status",), ("draw", "--output", "pair.svg"), ("export", "-")):
        name, *rest = command_line
        assert "did you mean 'table3'?" in refused(name, "table33", *rest)
    assert "campaigns/table3: holds no campaign" in refused("status", "table3")
    assert "holds no campaign" in refused("run", "./table3")
    assert "no such file" in refused("run", "none.toml")
    assert "holds no campaign" in refused("status", tmp_path / "nowhere")
    assert "holds no campaign" in refused("draw", tmp_path / "nowhere", "--output", "pair.svg")
    assert "holds no campaign to resume" in refused(
        "run", written(tmp_path), "--missing-only", "--out", tmp_path / "nowhere"
    )
    assert "'--scale': 0.0 is not in the range" in refused("run", "table3", "--scale", "0")


def test_a_ledger_of_another_version_gets_one_line(mavfi, tmp_path):
    folder = tmp_path / "old"
    folder.mkdir()
    database = sqlite3.connect(folder / LEDGER)
    database.execute("CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL)")
    database.execute("INSERT INTO meta VALUES ('schema', '7')")
    database.commit()
    database.close()
    for arguments in (("status", folder), ("run", folder)):
        done = mavfi("campaign", *arguments)
        assert done.returncode == 1
        assert re.search("version 7; .* version 1", done.stderr)


def test_plan_says_what_would_be_flown(mavfi, tmp_path):
    done = mavfi("campaign", "plan", "table3", "--scale", "0.1", "--json")
    told = json.loads(done.stdout)["campaign"]
    assert (told["missions"], told["pairs"]) == (40, 10)
    assert told["settings"]["setting=golden world=sparse"] == 10
    assert not list(tmp_path.iterdir())


def test_a_factor_is_replaced_in_a_folder_of_its_own(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("mavfi_cli.campaigns.run.fly_missing", lambda *_: None)
    line = ["run", str(written(tmp_path)), "--quiet"]
    invoke = CliRunner().invoke
    assert invoke(command.campaign, line).exit_code == 0
    done = invoke(command.campaign, [*line, "--set", "field=sign,exponent", "--scale", "0.5"])
    assert done.exit_code == 0, done.output
    changed = tmp_path / "campaigns" / "short-field=sign-exponent"
    assert sorted(changed.parent.iterdir()) == [changed.parent / "short", changed]
    spec = tomllib.loads((changed / "campaign.toml").read_text())
    assert spec["setting"][1]["field"] == ["sign", "exponent"]
    again = invoke(command.campaign, ["run", str(changed), "--quiet"])
    assert again.stdout.startswith("short-field=sign-exponent: 0 of 3 missions\n")
    both = invoke(command.campaign, ["run", str(changed), "--set", "world=dense"])
    assert "--scale, --set, --sampling, --worlds or --out" in str(both.exception)


def test_a_preset_s_name_that_is_also_a_campaign_s_folder_is_refused(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("mavfi_cli.campaigns.run.fly_missing", lambda *_: None)

    def called(*arguments):
        return CliRunner().invoke(command.campaign, arguments)

    begin = ("run", "fig8", "--out", "fig8", "--scale", "0.01", "--quiet")
    (tmp_path / "fig8").mkdir()  # as long as it holds no campaign, the name is the preset alone
    assert str(called("status", "fig8").exception).startswith("campaigns/fig8: ")
    for _ in range(2):  # --out says which is meant: begun, and gone on with by the same line
        assert called(*begin).stdout.startswith("fig8: 0 of ")
    for line in (("run", "fig8"), ("run", "fig8", "--scale", "0.01"), ("status", "fig8"),
                 ("export", "fig8", "-"), ("draw", "fig8", "--output", "pair.svg")):  # fmt: skip
        said = str(called(*line).exception)
        assert re.search(r"fig8 is a preset, .* \./fig8 .*campaigns/fig8", said)
    assert not (tmp_path / "campaigns").exists()
    assert called("plan", "fig8", "--scale", "0.01").exit_code == 0  # the preset: nothing is flown
    own = called("run", "fig8", "--out", "campaigns/fig8", "--scale", "0.02", "--quiet")
    assert own.exit_code == 0
    assert called("status", "campaigns/fig8").stdout == own.stdout
    assert called("status", "./fig8").stdout == called(*begin).stdout != own.stdout


def test_the_name_of_a_campaign_that_was_begun_is_told_with_its_folder(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("mavfi_cli.campaigns.run.fly_missing", lambda *_: None)
    invoke = CliRunner().invoke
    begun = invoke(command.campaign, ["run", str(written(tmp_path)), "--quiet"])
    assert begun.exit_code == 0, begun.output
    for line in (["status", "short"], ["run", "short"], ["plan", "short"]):
        said = str(invoke(command.campaign, line).exception)
        assert re.search("'short'.* 'campaigns/short'", said)
    assert "did you mean 'fig8'?" in str(invoke(command.campaign, ["status", "fig88"]).exception)


def test_set_names_the_nearest_factor(refused):
    for name in ("run", "plan"):
        assert "did you mean 'world'?" in refused(name, "fig8", "--set", "wrold=dense")
        assert "did you mean 'dense'?" in refused(name, "fig8", "--set", "world=dens")


def test_plan_answers_how_many_missions_a_question_takes(mavfi):
    done = mavfi("campaign", "plan", "--margin", "0.05", "--difference", "0.1")
    missions, pairs = done.stdout.splitlines()
    assert re.match(r"381 missions .* \+-0\.05 .* 0\.5, 95 %", missions)
    assert re.match(r"155 pairs: .* 0\.1 .* 80 % power, 95 % .* 20 % .*--discordant 0\.2", pairs)


@pytest.mark.parametrize(
    "arguments",
    [
        ("plan",),
        ("run",),
        ("run", "table3", "--keep", "some"),
        ("run", "table3", "--jobs", "0"),
        ("draw", "."),
        ("draw", ".", "--output", "pair.svg", "--pair", "-1"),
    ],
)
def test_wrong_usage_is_exit_code_2(mavfi, arguments):
    assert mavfi("campaign", *arguments).returncode == 2


def test_every_preset_is_named_in_the_help():
    from mavfi_cli.campaigns.specification_file import PRESETS

    for name in PRESETS.names:
        assert name in command.campaign.help


def test_help_needs_no_heavy_import():
    code = (
        "import sys; from mavfi_cli.cli.campaign import campaign; "
        "assert not {'numpy', 'numba', 'sqlite3', 'pyarrow'} & set(sys.modules), sys.modules"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
