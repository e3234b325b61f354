"""What is compared of a program, and that nothing outside of its scratch folder is touched."""

import json
import math
import re
import tempfile

import pytest
from click.testing import CliRunner

from mavfi_cli.attack.attacker import golden_run
from mavfi_cli.attack.comparison import OutputComparison
from mavfi_cli.attack.program import ProgramTarget
from mavfi_cli.attack.target import RunOutcome
from mavfi_cli.cli.kernels import kernels
from mavfi_cli.core.errors import ConfigError, TargetError
from mavfi_cli.core.processes import Ended
from mavfi_cli.fi.tracer.spawn import Program


@pytest.fixture
def place(native_program, tmp_path):
    """Function from a script of the shell and what is compared to the place where it runs."""
    native_program("counting")  # skips where nothing can be traced
    places = []

    def make(script, *outputs, **options):
        path = tmp_path / "script"
        path.write_text(f"{script}\n")
        target = ProgramTarget(
            command=Program.of(["sh", str(path)]),
            comparison=OutputComparison.of(outputs, **options),
        )
        places.append(target.open())
        return places[-1]

    yield make
    for each in places:
        each.close()


@pytest.fixture
def treasure(tmp_path):
    """A user's file that must survive."""
    path = tmp_path / "home" / "treasure.txt"
    path.parent.mkdir()
    path.write_text("mine\n")
    yield path
    assert path.read_text() == "mine\n"


@pytest.fixture
def command(native_program):
    """Run `mavfi kernels` on the program that writes files."""

    def run(*arguments, args=""):
        line = ["--program", str(native_program("writing")), "--args", args, "--runs", "3"]
        return CliRunner().invoke(kernels, [*line, *map(str, arguments)], terminal_width=1000)

    return run


# -- paths


@pytest.mark.parametrize(
    "outside", ["{}", "../treasure.txt", "a/../../treasure.txt", "..", ".", "/"]
)
def test_paths_that_lead_out_are_refused(command, treasure, monkeypatch, outside):
    monkeypatch.chdir(treasure.parent)
    name = outside.format(treasure)
    done = command("--compare", f"file:{name}", args=name)
    assert done.exit_code == 2
    assert re.search("--compare: .* leads out of", done.stderr)


@pytest.mark.parametrize(
    ("link", "output"),
    [("ln -s {treasure} out", "out"), ("ln -s {folder} sub", "sub/treasure.txt")],
)
def test_links_that_lead_out_are_neither_read_nor_followed(place, treasure, link, output):
    where = place(link.format(treasure=treasure, folder=treasure.parent), f"file:{output}")
    for _ in range(2):
        with pytest.raises(TargetError, match=f"writes no file {output}"):
            golden_run(where)


def test_links_that_stay_inside_are_followed(place):
    where = place("mkdir d; echo 42 > d/one; ln -s d/one latest", "file:latest")
    assert golden_run(where).output == b"42\n"


def test_every_run_begins_in_an_empty_folder(place, treasure):
    script = f"ls -A; ln -s {treasure.parent} link; echo 1 > out; echo 2 > more; ls -A"
    where = place(script, "file:out", "stdout")
    assert golden_run(where).output == b"== stdout\nlink\nmore\nout\n== out\n1\n"


def test_a_run_may_remove_its_own_folder(place):
    where = place('here=$(pwd); cd /; rmdir "$here"; echo 1')
    assert golden_run(where).output == b"1\n"


def test_an_argument_that_names_a_compared_file_is_the_programs_own(command, tmp_path, monkeypatch):
    """Else the program would write over the user's file of that name."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "out.txt").write_text("mine\n")
    done = command("--compare", "file:out.txt", "--json", args="out.txt")
    assert done.exit_code == 0, done.output
    assert (tmp_path / "out.txt").read_text() == "mine\n"


@pytest.mark.parametrize(("option", "value"), [("--memory", "inf"), ("--tolerance", "nan")])
def test_sizes_are_finite(command, option, value):
    done = command(option, value)
    assert done.exit_code == 2
    assert f"'{option}': {value} " in done.stderr


@pytest.mark.parametrize("jobs", [1, 2])
def test_nothing_is_left_behind(command, tmp_path, monkeypatch, jobs):
    scratch = tmp_path / "tmp"
    scratch.mkdir()
    monkeypatch.setenv("TMPDIR", str(scratch))
    monkeypatch.setattr(tempfile, "tempdir", None)
    done = command("--compare", "file:o", "--jobs", jobs, args="o")
    assert done.exit_code == 0, done.output
    assert not list(scratch.glob("mavfi-*"))


def test_a_scratch_folder_that_cannot_be_made_is_a_clear_error(command, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "gone"))
    done = command("--compare", "file:o", args="o")
    assert done.exit_code == 1
    assert str(done.exception) == f"{tmp_path / 'gone'}: No such file or directory"


# -- outputs


def test_a_file_that_the_golden_run_does_not_write_is_an_error(command):
    done = command("--compare", "file:result.txt", args="out.txt")
    assert done.exit_code == 1
    assert "writes no file result.txt" in str(done.exception)


def test_a_file_that_a_faulty_run_does_not_write_is_no_benign_outcome(place):
    where = place(": > out", "file:out")
    golden = golden_run(where)
    assert golden.output == b""
    where.start().kill()  # in a new folder, before it writes
    assert where.judge(golden, Ended(exit_code=0, signal=None)).outcome is RunOutcome.SDC


def test_several_outputs_are_compared(command, place):
    where = place("echo 1 > a; echo 2 > b; echo 3", "file:a", "file:b", "stdout")
    assert golden_run(where).output == b"== stdout\n3\n== a\n1\n== b\n2\n"
    done = command("--compare", "file:a", "--compare", "file:b", "--json", args="a b")
    assert done.exit_code == 0, done.output


def test_outputs_that_change_are_refused_and_lines_of_them_can_be_left_out(command):
    refused = command()
    assert "fault-free runs differ" in str(refused.exception)
    assert "at the line 'Time = " in str(refused.exception)
    assert "--ignore-lines" in str(refused.exception)
    done = command("--ignore-lines", "^Time", "--json")
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["runs"] == 3
    damaged = command("--ignore-lines", "(")
    assert "--ignore-lines: '(' " in damaged.stderr


def test_fault_free_runs_may_differ_within_the_tolerance(place, tmp_path):
    count = f"echo x >> {tmp_path}/count; echo sum = $((1000 + $(wc -l < {tmp_path}/count)))"
    assert golden_run(place(count, tolerance=0.01)).output == b"sum = 1001\n"
    with pytest.raises(TargetError, match=r"outputs differ .*'sum = "):
        golden_run(place(count, tolerance=1e-6))
    with pytest.raises(TargetError, match="their exit codes are"):
        golden_run(place(f"{count} > /dev/null; exit $(($(wc -l < {tmp_path}/count) % 7))"))


def test_standard_input_is_a_file(command, tmp_path):
    given = tmp_path / "given.txt"
    given.write_text("21\n")
    options = ("--compare", "file:o", "--stdin", given, "--out", tmp_path / "out", "--json")
    done = command(*options, args="o")
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["stdin"] == str(given)
    assert json.loads((tmp_path / "out" / "plan.json").read_text())["stdin"] == str(given)
    assert command("--stdin", tmp_path / "nothing").exit_code == 2


def test_standard_input_reaches_the_program(native_program, tmp_path):
    given = tmp_path / "given.txt"
    given.write_text("21\n")
    program = Program.of([str(native_program("writing")), "o"], stdin=given)
    where = ProgramTarget(command=program, comparison=OutputComparison.of(["file:o"])).open()
    assert golden_run(where).output == b"21 42\n"
    where.close()


# -- numbers


@pytest.mark.parametrize(
    ("golden", "output", "size"),
    [
        (b"1 2 3", b"1 2 3", 0.0),
        (b"x=2.0", b"x=3.0", 0.5),
        (b"0", b"0.25", 0.25),
        (b"1", b"nan", math.inf),
        (b"1 2", b"1", None),
        (b"a", b"b", None),
    ],
)
def test_magnitude(golden, output, size):
    found = OutputComparison().difference(golden, output)
    assert (found and found.relative) == size


def test_what_can_be_compared():
    assert OutputComparison.of(["file:./out.txt"]).files == ("out.txt",)
    assert OutputComparison.of([]) == OutputComparison.of(["stdout"]) == OutputComparison()
    assert OutputComparison.of(["stdout", "file:a", "stdout"]).to_json()["file"] == [None, "a"]
    with pytest.raises(ConfigError, match="must be stdout or file:PATH"):
        OutputComparison.of(["stderr"])
