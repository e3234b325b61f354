"""No argument and no link leads a program from its folder to a file of the user."""

import os
from pathlib import Path

import pytest
from click.testing import CliRunner

from mavfi_cli.attack import work_folder
from mavfi_cli.attack.work_folder import WorkFolder, copied_arguments
from mavfi_cli.cli.kernels import kernels
from mavfi_cli.core.errors import TargetError


@pytest.fixture
def home(tmp_path, monkeypatch):
    """The user's folder, in which the command is called; a folder of it is `data`."""
    home = tmp_path / "home"
    (home / "data" / "deep").mkdir(parents=True)
    (tmp_path / "outside").mkdir()
    for name in ("in.txt", "data/in.txt", "data/deep/one", "../outside/far.txt"):
        (home / name).write_text(f"mine: {name}\n")
    monkeypatch.chdir(home)
    return home


def files_of(folder):
    """The text of every file below a folder, by name."""
    found = (Path(at) / name for at, _, names in os.walk(folder) for name in names)
    return {str(path.relative_to(folder)): path.read_text() for path in found if path.is_file()}


@pytest.fixture
def made(tmp_path, home):
    """Function from folder and sources to the program's folder of the first run."""

    def make(folder=None, **sources):
        scratch = tmp_path / "scratch"
        scratch.mkdir()
        work = WorkFolder(scratch, folder, sources.get("sources", {}), "guest")
        work.renew()
        return work

    return make


# -- arguments


@pytest.mark.parametrize(
    ("argument", "name", "source"),
    [
        ("in.txt", "in.txt", "in.txt"),
        ("./in.txt", "./in.txt", "in.txt"),
        ("data/deep/", "data/deep/", "data/deep"),
        ("data/../in.txt", "in.txt", "in.txt"),
        ("../outside/far.txt", "../outside/far.txt", "../outside/far.txt"),
        ("data", "data", None),  # any word may be the name of a folder
        ("5", "5", None),
        ("", "", None),
        ("/etc/passwd", "/etc/passwd", None),
        ("x" * 5000, "x" * 5000, None),
        ("a/" * 5000, "a/" * 5000, None),
    ],
)
def test_relative_arguments_that_name_files_are_copied(home, argument, name, source):
    copies = {} if source is None else {os.path.normpath(name): (home / source).resolve()}
    assert copied_arguments([argument], home, None) == ([name], copies)


@pytest.mark.parametrize(
    ("argument", "name"),
    [
        ("in.txt", "in.txt"),  # that of the folder
        ("data/in.txt", "in.txt"),
        ("{home}/data/in.txt", "in.txt"),
        ("{home}/data/out.txt", "out.txt"),
        ("of={home}/data/in.txt", "of=in.txt"),
        ("--out=data/out.txt", "--out=data/out.txt"),
        ("-DA={home}/in.txt", "-DA={home}/in.txt"),
        ("data/deep/", "deep"),
        ("deep/one", "deep/one"),
        ("out.txt", "out.txt"),
        ("{home}/in.txt", "{home}/in.txt"),
        ("x" * 5000, "x" * 5000),
    ],
)
def test_arguments_that_name_something_in_the_folder_name_its_copy(home, argument, name):
    arguments, sources = copied_arguments([argument.format(home=home)], home, home / "data")
    assert (arguments, sources) == ([name.format(home=home)], {})


def test_the_value_of_an_option_is_copied_unless_the_whole_argument_names_a_file(home):
    (home / "if=in.txt").write_text("mine")
    arguments, sources = copied_arguments(["of=in.txt", "x=5", "=", "if=in.txt"], home, None)
    assert arguments == ["of=in.txt", "x=5", "=", "if=in.txt"]
    assert sources == {name: home / name for name in ("in.txt", "if=in.txt")}


def test_a_file_beside_the_folder_is_copied_beside_the_copy(home, made):
    arguments, sources = copied_arguments(["../outside/far.txt", "in.txt"], home, home / "data")
    work = made(home / "data", sources=sources)
    texts = [(work.path / argument).read_text() for argument in arguments]
    assert texts == ["mine: ../outside/far.txt\n", "mine: data/in.txt\n"]
    assert all((work.path / each).resolve().is_relative_to(work.tree) for each in arguments)


@pytest.fixture
def attack(native_program, home):
    """Run `mavfi kernels` on a program that writes to the files of its arguments."""

    def run(args, *options):
        line = ["--program", str(native_program("writing")), "--args", args, "--runs", "3"]
        line += ["--ignore-lines", "^Time"]
        return CliRunner().invoke(kernels, [*line, *map(str, options)])

    return run


@pytest.mark.parametrize(
    ("args", "options"),
    [
        ("in.txt", ()),
        ("../outside/far.txt data/in.txt ./in.txt", ()),
        ("in.txt", ("--folder", ".")),
        ("data/in.txt", ("--folder", "data")),
        ("{home}/data/in.txt", ("--folder", "data")),
        ("to=in.txt --to=./data/in.txt", ()),
        ("--to={home}/data/in.txt to=in.txt", ("--folder", "data")),
        ("link", ("--folder", "data")),
        ("ring/in.txt", ("--folder", "data", "--compare", "file:ring/in.txt")),
    ],
)
def test_a_program_never_writes_to_a_file_of_the_user(attack, home, args, options):
    (home / "data/link").symlink_to("../../outside/far.txt")
    (home / "data/ring").symlink_to(home / "data")
    before = files_of(home.parent)
    done = attack(args.format(home=home), *options)
    assert done.exit_code == 0, done.output
    assert "outside its folder" not in done.stderr
    assert files_of(home.parent) == before


def test_a_campaign_with_copied_arguments_is_repeated(attack, home):
    done = attack("in.txt", "--compare", "file:in.txt", "--out", "faults")
    assert done.exit_code == 0, done.output
    done = attack("in.txt", "--compare", "file:in.txt", "--replay", "faults")
    assert done.output == "3 of 3 replays identical\n"


# -- links and special files


def test_links_out_are_copied_and_links_inside_stay_inside(made, home):
    data = home / "data"
    (data / "far").symlink_to("../../outside")
    (data / "file").symlink_to(home / "in.txt")
    (data / "absolute").symlink_to(data / "in.txt")
    (data / "deep" / "up").symlink_to("../in.txt")
    (data / "around").symlink_to("../data/deep")
    (data / "top").symlink_to(".")
    (data / "later").symlink_to("not-yet.txt")
    # It looks as if it stayed inside.
    (data / "deep" / "top").symlink_to("..")
    (data / "sly").symlink_to("deep/top/../../outside/far.txt")
    folder = made(data).path
    assert (folder / "far/far.txt").read_text() == "mine: ../outside/far.txt\n"
    assert (folder / "sly").read_text() == "mine: ../outside/far.txt\n"
    links = {path.name for path in folder.rglob("*") if path.is_symlink()}
    assert links == {"absolute", "up", "around", "top", "later"}
    assert (folder / "absolute").samefile(folder / "in.txt")
    assert (folder / "deep/up").samefile(folder / "in.txt")
    for at, folders, names in os.walk(folder, followlinks=False):
        for name in folders + names:
            assert (Path(at) / name).resolve().is_relative_to(folder)


@pytest.mark.parametrize("name", ["up", "zero", "pipe", "gone", "many", "large"])
def test_what_cannot_be_copied_is_refused(made, home, monkeypatch, name):
    path = home / "data" / name
    monkeypatch.setattr(work_folder, "MOST_FILES", 20)
    monkeypatch.setattr(work_folder, "LARGEST_BYTES", 1 << 20)
    if name == "pipe":
        os.mkfifo(path)
    elif name == "many":
        path.mkdir()
        for number in range(20):
            (path / str(number)).touch()
    elif name == "large":
        with path.open("wb") as file:
            file.truncate((1 << 20) + 1)
    else:
        path.symlink_to({"up": "..", "zero": "/dev/zero", "gone": "/gone/away"}[name])
    expected = {
        "up": f"{path}/data cannot be copied: .* cycle",
        "zero": f"{path} cannot be copied: .* neither a file nor a folder",
        "pipe": f"{path} cannot be copied: .* neither a file nor a folder",
        "gone": f"its files cannot be copied: .*'{path}'",
    }
    with pytest.raises(TargetError, match=expected.get(name, "name large inputs by absolute")):
        made(home / "data")


# -- what a run wrote


def test_a_file_that_was_there_before_does_not_count_as_written(attack, home):
    done = attack("", "--folder", "data", "--compare", "file:in.txt")
    assert done.exit_code == 1
    assert "writes no file in.txt" in str(done.exception)
    done = attack("in.txt", "--folder", "data", "--compare", "file:in.txt")
    assert done.exit_code == 0, done.output


def test_a_file_is_written_if_its_contents_or_its_time_are_new(made, home):
    work = made(home / "data")
    path = work.path / "in.txt"
    assert not work.wrote("in.txt")
    before = path.stat()
    path.write_bytes(path.read_bytes().upper())
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))  # as after a write by a mapping
    assert work.wrote("in.txt")
    work.renew()
    assert not work.wrote("in.txt")
    path.write_bytes(path.read_bytes())
    assert work.wrote("in.txt")
