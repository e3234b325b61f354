"""The documents: commands run, examples work, links lead somewhere."""

import html
import json
import os
import re
import shlex
import signal
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import click
import pytest
from fake_autopilot import FakePX4
from pyarrow.parquet import read_schema, read_table
from test_code_blocks import WIDEST

from mavfi_cli import cli
from mavfi_cli.analysis.flights import EXPORTED
from mavfi_cli.core.types import BY_NAME
from mavfi_cli.spec.mission import MissionConfig

ROOT = Path(__file__).parents[2]
DOCUMENTS = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])


def command(word):
    """Words of the command of docs/how-to/autopilot.md that has a word, without `mavfi`."""
    lines = (ROOT / "docs/how-to/autopilot.md").read_text().splitlines()
    found = (each for each in lines if each.startswith("mavfi") and word in each)
    return shlex.split(next(found), comments=True)[1:]


def test_the_vehicle_alone(tmp_path, free_port):
    """With its onboard link on a free port, for others may fly on this machine."""
    arguments = [*command("sitl"), "--link", f"onboard=udpout:127.0.0.1:{free_port}"]
    process = subprocess.Popen(
        [sys.executable, "-m", "mavfi_cli", *arguments],
        stderr=subprocess.PIPE, text=True, cwd=tmp_path, start_new_session=True,
    )  # fmt: skip
    try:
        heard = []
        for told in process.stderr:
            heard.append(told)
            if told.startswith("Ctrl-C ends it"):
                break
    finally:
        os.killpg(process.pid, signal.SIGINT)
        process.communicate(timeout=30.0)
    assert any(told.startswith("world farm ") for told in heard)  # compiling is told before
    assert any(f"MAVSDK    udpin://127.0.0.1:{free_port}" in told for told in heard)
    assert process.returncode == 0


def test_a_foreign_autopilot(mavfi, autopilot_on_udp, free_port, tmp_path):
    autopilot_on_udp(FakePX4())
    line = [word.replace("14540", str(free_port)) for word in command("--link")]
    done = mavfi(*line, "--time-limit", "1", "--no-land", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("TIMEOUT")


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_relative_link_leads_to_a_file(document):
    text = re.sub(r"^```.*?^```$", "", document.read_text(), flags=re.DOTALL | re.M)
    targets = re.findall(r"\]\(([^)\s]+)\)", text)
    inside = [t.partition("#")[0] for t in targets if "://" not in t and not t.startswith("#")]
    missing = [target for target in inside if not (document.parent / target).exists()]
    assert missing == []


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_named_file_exists(document):
    folders = "mavfi_cli|sitl|tests|benchmarks|examples|docs"
    named = re.findall(rf"\b(?:{folders})/[\w./*-]*[\w/*]", document.read_text())
    assert [path for path in named if not any(ROOT.glob(path.rstrip("/")))] == []


def named_commands(document):
    """The words of each command of mavfi that a page names, without `mavfi`."""
    text = document.read_text().replace("\\\n", " ")
    blocks = re.findall(r"^```\w*\n(.*?)^```", text, flags=re.DOTALL | re.M)
    lines = [line.removeprefix("$ ") for block in blocks for line in block.splitlines()]
    for line in (*re.findall(r"(?<!`)`([^`]+)`(?!`)", text), *lines):
        if line.startswith("mavfi "):
            yield shlex.split(" ".join(line.split()), comments=True)[1:]


@pytest.fixture(scope="module")
def help_texts():
    """The help of each command, asked for once."""
    return {}


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_named_option_exists(document, mavfi, help_texts):
    if document.name == "CHANGELOG.md":
        pytest.skip("it also names options that are gone")
    wrong = []
    for words in named_commands(document):
        options = {word.partition("=")[0] for word in words if re.match("--?[a-z]", word)}
        if options and words[0].islower():
            names = tuple(words[: 2 if words[0] in ("campaign", "detect", "world") else 1])
            if names not in help_texts:
                help_texts[names] = mavfi(*names, "--help").stdout
            wrong += [
                (words, each) for each in options if not re.search(rf"{each}\b", help_texts[names])
            ]
    assert wrong == []


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_placeholder_is_left(document):
    assert "@@" not in document.read_text()


def told_columns(page):
    """What a page of the reference names in code."""
    return set(re.findall(r"`(\w+)`", (ROOT / "docs" / "reference" / page).read_text()))


def test_the_reference_names_everything_in_a_run_folder(short_flight):
    told = told_columns("records.md") | set(BY_NAME)
    tables = short_flight.path.glob("*.parquet")
    columns = {name for each in tables for name in read_schema(each).names}
    result = json.loads((short_flight.path / "result.json").read_text())
    assert (columns | set(result)) - told == set()


def test_no_committed_export_names_a_folder_of_the_computer_that_flew_it():
    exports = [*ROOT.glob("docs/results/*.parquet")]
    tables = [read_table(each) for each in exports if "path" in read_schema(each).names]
    paths = {path for table in tables for path in table["path"].to_pylist() if path}
    assert paths
    assert {path for path in paths if not re.fullmatch(r"runs/[\w.-]+", path)} == set()


def test_the_reference_names_every_column_of_an_export():
    page = (ROOT / "docs" / "reference" / "campaigns.md").read_text()
    table = page.partition("## Columns of an export")[2].partition("\n## ")[0]
    rows = (line.split("|") for line in table.splitlines() if line.startswith("| `"))
    told = {name for row in rows for name in re.findall(r"`(\w+)`", row[1])}
    assert {*EXPORTED, "label_NAME"} == told


def build(builder, folder):
    """Build the documents with warnings as errors."""
    line = ["-q", "-W", "--keep-going", "-b", builder, "-d", folder / "cache", ROOT / "docs"]
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", *line, folder / builder],
        capture_output=True, text=True, check=False, env={**os.environ, "PATH": path},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


# What Python shows of an object that no reader knows.
OBJECT = re.compile(r"Sentinel|\w+ object at 0x|&lt;(?:function |lambda&gt;|class ')|PosixPath")


def wide_lines(page):
    """The lines of code of a built page that scroll."""
    blocks = re.findall(r"<pre>(.*?)</pre>", page, flags=re.DOTALL)
    lines = html.unescape(re.sub(r"<[^>]+>", "", "\n".join(blocks))).splitlines()
    return [line for line in lines if len(line) > WIDEST]


@pytest.mark.slow
def test_the_pages_build_without_a_warning(tmp_path):
    """A warning is a dead link, a page that no other lists, or a name that no longer exists."""
    build("html", tmp_path)
    told = (tmp_path / "html" / "reference" / "commands.html").read_text()
    assert "--fault-seed" in told
    assert "--allow-unsigned" in told  # of `mavfi sitl`, whose help is its own
    commands = cli.cli.list_commands(click.Context(cli.cli))
    assert [name for name in commands if f'id="mavfi-{name}"' not in told] == []
    texts = {str(path): path.read_text() for path in (tmp_path / "html").rglob("*.html")}
    assert {name: OBJECT.findall(text) for name, text in texts.items() if OBJECT.search(text)} == {}
    assert {name: wide for name, text in texts.items() if (wide := wide_lines(text))} == {}
    index = (tmp_path / "html" / "searchindex.js").read_text()
    entries = json.loads(index.removeprefix("Search.setIndex(").removesuffix(")"))["indexentries"]
    assert "golden run" in entries  # a search for it begins with the glossary
    settings = (tmp_path / "html" / "reference" / "settings.html").read_text()
    assert [each.name for each in fields(MissionConfig) if each.name not in settings] == []
    build("man", tmp_path)
    assert "--fault-seed" in (tmp_path / "man" / "mavfi.1").read_text().replace("\\", "")
