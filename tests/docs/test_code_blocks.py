"""Every code block of the documents runs, or says why it does not.

The blocks of a page run one after the other in one empty folder, as a reader would run them. Only
the mavfi commands of a block without other commands run in the process of the test, which has
loaded everything. docs/contributing.md explains the comments before a block ("Add a page").
"""

import contextlib
import os
import re
import shlex
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import pytest
from markdown_it import MarkdownIt

ROOT = Path(__file__).parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])
COMMENT = re.compile(r"<!-- (not run|[a-z ]+ with|file)(?:: (.+?))? -->", re.DOTALL)
COMMAND = r"(?m)^(mavfi {}(?:[^#\n\\]|\\\n)*)"
QUOTED = re.compile(r"""'[^']*'|"[^"$`\\]*\"""")
SHELL = re.compile(r"""[][$`*?~!|&;<>(){}"'\\]""")
NEAR = (
    'name = "near"\nbounds_enu_m = [-10.0, -10.0, 0.0, 20.0, 10.0, 20.0]\n'
    "start_enu_m = [0.0, 0.0, 0.0]\ngoal_enu_m = [10.0, 0.0, 5.0]\n"
    "[[box]]\nmin_enu_m = [4.0, 6.0, 0.0]\nmax_enu_m = [5.0, 7.0, 2.0]\n"
)
LONGEST_S = 900.0
WIDEST = 100  # characters; docs/static/tables.css has room for them in a window of 1280 pixels


@dataclass(frozen=True, slots=True, kw_only=True)
class Block:
    """A fenced block; `notes` are its comments by their first words."""

    place: str
    language: str
    text: str
    notes: dict[str, str]

    @property
    def is_run(self):
        return self.language != "text" and "not run" not in self.notes

    @property
    def words(self):
        """The words that commands get, by the beginning of the command."""
        with_words = {note: text for note, text in self.notes.items() if note.endswith(" with")}
        return {
            "" if note == "run with" else note.removesuffix("with"): text
            for note, text in with_words.items()
        }


def blocks(page):
    """The blocks of a page, without those that sphinx runs."""
    notes = {}
    for token in MarkdownIt().parse(page.read_text()):
        if token.type == "html_block":
            notes |= dict(COMMENT.findall(token.content))
            continue
        if token.type == "fence" and not token.info.startswith("{"):
            place = f"{page.relative_to(ROOT)}:{token.map[0] + 1}"
            yield Block(place=place, language=token.info.strip(), text=token.content, notes=notes)
        notes = {}


class Session:
    """A reader who does what a page says, in a folder. `mavfi` runs a command in this process."""

    def __init__(self, folder, mavfi):
        self.folder, self._mavfi = folder, mavfi
        (folder / ".near.toml").write_text(NEAR)
        self.names = {"__name__": "__main__"}
        installed = folder / "installed"
        self.environment = os.environ | {
            "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
            "PYTHONPATH": f"{installed}{os.pathsep}{folder}",
            "PIP_TARGET": str(installed),
            "PIP_NO_INDEX": "1",
            "PIP_NO_DEPS": "1",
            "PIP_NO_BUILD_ISOLATION": "0",  # pip reads this as: without isolation
        }
        self._installed = installed

    def run(self, block):
        if "file" in block.notes:
            path = self.folder / block.notes["file"]
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(block.text)
        if block.language == "toml":
            tomllib.loads(block.text)
        elif "file" not in block.notes:
            {"sh": self._script, "console": self._console, "python": self._python}[block.language](
                block
            )

    def _python(self, block):
        with contextlib.chdir(self.folder):
            exec(compile(block.text, block.place, "exec"), self.names)

    def _script(self, block):
        self._bash(block.text, block)

    def _console(self, block):
        """A command is expected to fail if it shows an error."""
        for command, shown in commands(block.text):
            told = self._bash(command, block, fails=any(each.startswith("error") for each in shown))
            missing = [] if block.words else [line for line in shown if line not in told]
            assert missing == [], (block.place, command, told)

    def _bash(self, script, block, *, fails=False):
        """Run a script; the lines that it prints, without white space around them."""
        longer = script
        for begin, words in block.words.items():
            longer = re.sub(COMMAND.format(begin), rf"\1 {words} ", longer)
        code, told = self._run(longer)
        assert (code != 0) == fails, (block.place, script, told)
        return {line.strip() for line in told.splitlines()}

    def _run(self, script):
        """Run a script; its exit code and what it prints."""
        lines = None if self._installed.exists() else mavfi_lines(script)
        if lines is None:
            done = subprocess.run(
                ["bash", "-euo", "pipefail", "-c", script],
                cwd=self.folder, env=self.environment, check=False, timeout=LONGEST_S,
                stdout=subprocess.PIPE, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL,
                text=True,
            )  # fmt: skip
            return done.returncode, done.stdout
        code, told = 0, ""
        for words in lines:
            if code == 0:
                with mock.patch.dict(os.environ, self.environment):
                    done = self._mavfi(*words, cwd=self.folder)
                code, told = done.returncode, told + done.stdout + done.stderr
        return code, told


def commands(text):
    """The commands of a console block, each with the lines that it shows below it."""
    for part in re.split(r"^\$ ", text, flags=re.MULTILINE)[1:]:
        command, shown = re.fullmatch(r"((?:.*\\\n)*.*\n)((?s:.*))", part).groups()
        lines = {line.strip() for line in shown.splitlines()} - {"", "..."}
        yield command, sorted(lines)


def mavfi_lines(script):
    """The arguments of each command of a script; None if one is not mavfi's or needs a shell."""
    lines = []
    for line in script.replace("\\\n", " ").splitlines():
        bare = QUOTED.sub("", line.partition(" #")[0])
        if (bare and not bare.startswith("mavfi ")) or SHELL.search(bare):
            return None
        lines += [shlex.split(line, comments=True)[1:]] if bare else []
    return lines


def sessions():
    """For each page with blocks that run: those blocks, as parameters of a test."""
    pages = {page: [block for block in blocks(page) if block.is_run] for page in PAGES}
    return [pytest.param(run, id=str(page.relative_to(ROOT))) for page, run in pages.items() if run]


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_block_runs_or_says_why_not(page):
    known = ("sh", "console", "python", "toml")
    wrong = [
        block.place for block in blocks(page)
        if block.is_run and block.language not in known and "file" not in block.notes
    ]  # fmt: skip
    assert wrong == []


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_words_for_a_command_find_it(page):
    unused = [
        (block.place, begin)
        for block in blocks(page)
        for begin in block.words
        if f"mavfi {begin}" not in block.text
    ]
    assert unused == []


def test_no_line_of_a_block_scrolls():
    pages = [page for page in PAGES if ROOT / "docs" in page.parents]
    wide = [
        (block.place, line)
        for page in pages
        for block in blocks(page)
        for line in block.text.splitlines()
        if len(line) > WIDEST
    ]
    assert wide == []


@pytest.mark.slow
@pytest.mark.parametrize("run", sessions())
def test_the_blocks_of_a_page_run(run, tmp_path, mavfi):
    session = Session(tmp_path, mavfi)
    for block in run:
        session.run(block)


@pytest.mark.parametrize("text", ["$ echo one\ntwo\n", "$ false\n", "$ true\nerror: none\n"])
def test_a_page_that_is_wrong_is_found(text, tmp_path, mavfi):
    block = Block(place="here", language="console", text=text, notes={})
    with pytest.raises(AssertionError, match="here"):
        Session(tmp_path, mavfi).run(block)


@pytest.mark.parametrize(
    "text", ["$ mavfi stacks\nnobody\n", "$ mavfi no\n", "$ mavfi stacks\nerror: none\n"]
)
def test_a_command_in_this_process_that_is_wrong_is_found(text, tmp_path, mavfi):
    test_a_page_that_is_wrong_is_found(text, tmp_path, mavfi)


@pytest.mark.parametrize(
    ("script", "lines"),
    [
        ("mavfi a --b 'c d'  # what? (this)\nmavfi e \\\n  f\n", [["a", "--b", "c d"], ["e", "f"]]),
        ("mavfi a\ncat b\n", None),
        ("mavfi a > b\n", None),
        ("mavfi a $HOME\n", None),
    ],
)
def test_only_plain_commands_of_mavfi_run_without_a_shell(script, lines):
    assert mavfi_lines(script) == lines
