"""Programs that misbehave or cannot be attacked: each ends with one clear line."""

import contextlib
import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from click.testing import CliRunner

from mavfi_cli.attack.comparison import OutputComparison
from mavfi_cli.attack.program import ProgramTarget
from mavfi_cli.attack.target import RunLimits
from mavfi_cli.cli.kernels import kernels
from mavfi_cli.core.errors import MavfiError, TargetError
from mavfi_cli.fi.tracer.spawn import Program

CAP_NET_RAW = b"\1\0\0\2\0\x20" + bytes(14)  # struct vfs_cap_data of linux/capability.h


@pytest.fixture
def attack(native_program, tmp_path):
    """Run `mavfi kernels` on a program, three faults."""

    def run(args="", *options, program=None):
        folder = tmp_path / "out"
        shutil.rmtree(folder, ignore_errors=True)
        path = program or native_program("guest")
        line = ["--program", str(path), "--args", args, "--runs", "3", *map(str, options)]
        return CliRunner().invoke(kernels, [*line, "--out", str(folder)])

    return run


def refused(done):
    """The one line of the error."""
    assert done.exit_code == 1
    assert isinstance(done.exception, MavfiError), done.exception
    text = str(done.exception)
    assert "\n" not in text
    return text


def test_one_that_prints_100_mb(attack):
    assert "prints more than 64 MB" in refused(attack("prints"))


def test_one_that_needs_more_memory_than_it_gets(attack):
    text = refused(attack("eats", "--memory", "0.5"))
    assert re.search(r"exit code 9 .* 0\.5 GB; --memory", text)
    assert "more than 2 GB" in refused(attack("eats"))
    done = attack("eats", "--memory", "4")
    assert done.exit_code == 0, done.output


def test_one_that_writes_outside_its_folder_is_attacked_with_a_warning(attack, tmp_path):
    done = attack(f"writes {tmp_path}/mine")
    assert done.exit_code == 0, done.output
    assert f"outside its folder: {tmp_path}/mine" in done.stderr
    assert (tmp_path / "mine").read_text() == "x"


def test_one_that_ends_with_an_exit_code_is_attacked_with_a_warning(native_program):
    line = ["--program", str(native_program("writing")), "--args", "nowhere/file", "--runs", "1"]
    done = CliRunner().invoke(kernels, [*line, "--ignore-lines", "^Time"])
    assert "warning: writing ends with exit code 3" in done.stderr


def test_one_that_writes_a_file_that_is_not_compared_is_attacked_with_a_warning(attack):
    done = attack("writes here")
    assert done.exit_code == 0, done.output
    assert "warning: guest writes here, " in done.stderr
    assert "--compare file:here compares it" in done.stderr
    assert not Path("here").exists()
    done = attack("writes here", "--compare", "file:here")
    assert done.exit_code == 0, done.output
    assert "warning" not in done.stderr


def test_a_script(attack, tmp_path):
    script = tmp_path / "run.sh"
    script.write_text("#!/bin/sh\necho 1\n")
    script.chmod(0o755)
    text = refused(attack(program=script))
    assert f"--program /bin/sh --args '{script}'" in text
    script.write_text("#!/usr/bin/env python3\n")
    assert f"--program python3 --args '{script}'" in refused(attack(program=script))


def test_a_set_uid_program(attack, native_program, tmp_path):
    path = tmp_path / "risen"
    path.write_bytes(native_program("counting").read_bytes())
    path.chmod(0o4755)
    assert "is set-uid or set-gid" in refused(attack(program=path))
    path.chmod(0o755)
    assert attack("30", program=path).exit_code == 0
    with contextlib.suppress(PermissionError):  # only root may
        os.setxattr(path, "security.capability", CAP_NET_RAW)
        assert "has file capabilities" in refused(attack(program=path))


def test_a_program_for_another_processor(attack, native_program, tmp_path):
    path = tmp_path / "foreign"
    code = bytearray(native_program("counting").read_bytes())
    code[18:20] = b"\xb7\0"  # EM_AARCH64
    path.write_bytes(code)
    path.chmod(0o755)
    assert "is not a program for x86-64" in refused(attack(program=path))


@pytest.mark.slow
@pytest.mark.parametrize("length", ["30", "30000"])
def test_a_statically_linked_program_works(attack, native_program, length):
    try:
        path = native_program("counting", "-static")
    except subprocess.CalledProcessError:
        pytest.skip("no static libc")
    done = attack(length, program=path)
    assert done.exit_code == 0, done.output
    assert "scope: counting-static" in done.stdout


def test_one_that_needs_a_terminal(attack):
    text = refused(attack("asks"))
    assert "(no terminal here)" in text


@pytest.mark.parametrize(
    ("args", "program", "what"),
    [
        ("", "threads", "thread (system call clone"),
        ("", "parent", "child process (system call clone)"),
        ("execs", "guest", "(system call execve)"),
    ],
)
def test_threads_and_children_are_refused_by_name(attack, native_program, args, program, what):
    options = ("--ignore-lines", "[0-9]")
    text = refused(attack(args, *options, program=native_program(program)))
    assert what in text
    assert "does not follow" in text


@pytest.mark.parametrize("what", ["waits", "pipes"])
def test_one_that_never_ends(native_program, what):
    command = Program.of([str(native_program("guest")), what])
    limits = RunLimits(golden_s=1.0)
    where = ProgramTarget(command=command, comparison=OutputComparison(), limits=limits).open()
    with pytest.raises(TargetError, match="within 1 s"):
        where.fault_free()
    where.close()


def test_a_run_works_in_a_copy_of_a_folder(attack, tmp_path):
    folder = tmp_path / "inputs"
    folder.mkdir()
    (folder / "in").write_text("from the\n")
    done = attack("reads", "--folder", folder)
    assert done.exit_code == 0, done.output
    assert os.listdir(folder) == ["in"]
    plan = json.loads((tmp_path / "out" / "plan.json").read_text())
    assert plan["folder"] == str(folder)


def test_the_environment_is_small_and_recorded(attack, tmp_path, monkeypatch):
    monkeypatch.setenv("SECRET", "42")
    done = attack("says SECRET", "--env", "COLOUR=red=blue")
    assert done.exit_code == 0, done.output
    plan = json.loads((tmp_path / "out" / "plan.json").read_text())
    assert plan["environment"]["COLOUR"] == "red=blue"
    assert "SECRET" not in plan["environment"]
    assert "PWD" not in plan["environment"]
    wrong = attack("says X", "--env", "X")
    assert wrong.exit_code == 2
    assert "--env" in wrong.output
