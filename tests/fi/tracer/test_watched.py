"""What a watched program is seen to do."""

import os

import pytest

from mavfi_cli.fi.tracer.spawn import watch


@pytest.mark.parametrize("name", ["out", "./below/../out", "{}/far", "../far"])
def test_written_paths_are_absolute(start, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    given = name.format(tmp_path)
    os.mkdir(tmp_path / "below")
    watched = watch(start("guest", "writes", given), wall_s=20.0)
    assert watched.written == [os.path.normpath(tmp_path / given)]
    assert not watched.started


def test_what_is_only_read_is_not_written(start, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "in").write_text("text\n")
    assert watch(start("guest", "reads"), wall_s=20.0).written == []


def test_a_program_that_goes_on_is_ended(start):
    tracee = start("guest", "waits")
    assert not watch(tracee, wall_s=0.3).started
    assert tracee.ended.signal == 9


def test_signals_reach_a_watched_program(start):
    tracee = start("signals")
    assert not watch(tracee, wall_s=20.0).started
    assert tracee.ended.exit_code == 0
