import os
import signal
import subprocess
import sys
import zlib
from pathlib import Path
from unittest import mock

import pyarrow as pa
import pytest

from mavfi_cli.core.compiled import folder_digest
from mavfi_cli.core.errors import RecordError
from mavfi_cli.core.files import (
    ScratchFolder,
    file_digest,
    inflate,
    open_own,
    own_folder,
    read_bounded,
    read_json,
    read_parquet,
    write_parquet,
    write_text,
)
from mavfi_cli.core.processes import fork

_MAKE_AND_WAIT = """
import sys
from mavfi_cli.core.files import ScratchFolder
scratch = ScratchFolder("test")
print(scratch.path, flush=True)
sys.stdin.read()
"""


def _maker(place):
    """Start a process that makes a scratch folder; return both."""
    process = subprocess.Popen(
        [sys.executable, "-c", _MAKE_AND_WAIT], text=True, env={**os.environ, "TMPDIR": str(place)},
        stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    )  # fmt: skip
    return process, Path(process.stdout.readline().strip())


def test_the_next_process_removes_the_scratch_folder_of_a_killed_one_and_nothing_else(tmp_path):
    mine = tmp_path / "mine"
    (mine / "kept").mkdir(parents=True)
    (mine / ".mavfi-scratch").touch()
    (tmp_path / "mavfi-link").symlink_to(mine)
    (tmp_path / "mavfi-notes").mkdir()  # named as ours, made by a user
    killed, left = _maker(tmp_path)
    killed.send_signal(signal.SIGKILL)
    killed.communicate()
    assert left.is_dir()
    running, its = _maker(tmp_path)
    ending, last = _maker(tmp_path)
    try:
        assert {path.name for path in tmp_path.iterdir()} == {
            "mine", "mavfi-link", "mavfi-notes", its.name, last.name,
        }  # fmt: skip
        assert (mine / "kept").is_dir()
    finally:
        running.kill()
        running.communicate()
        ending.communicate()
    assert not last.exists()


def test_a_scratch_folder_ends_with_its_block_and_a_fork_does_not_remove_it(tmp_path):
    with ScratchFolder("test", tmp_path) as folder:
        (folder / "file").touch()

        def leave():
            scratch.close()
            return 0

        scratch = ScratchFolder("test", tmp_path)
        os.waitpid(fork(leave), 0)
        assert scratch.path.is_dir()
    assert not folder.exists()
    with pytest.raises(RecordError, match="missing: No such file"):
        ScratchFolder("test", tmp_path / "missing")


def test_what_utf_8_does_not_have_is_written_escaped(tmp_path):
    write_text(tmp_path / "crash.txt", "a corrupted name: \udc80")
    assert (tmp_path / "crash.txt").read_bytes() == rb"a corrupted name: \udc80"


def test_a_deep_digest_depends_on_settings_and_a_shallow_one_on_sources_only(tmp_path):
    def digests(value):
        folder = tmp_path / str(value)
        (folder / "stacks").mkdir(parents=True)
        (folder / "code.py").write_text("pass")
        (folder / "stacks" / "own.toml").write_text(f"gain = {value}")
        return folder_digest(folder), folder_digest(folder, deep=True)

    (shallow, deep), (same, other) = digests(1), digests(2)
    assert shallow == same
    assert deep != other


def test_nothing_is_written_through_a_link(tmp_path):
    precious = tmp_path / "precious"
    precious.write_text("mine")
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / f".out.txt.{os.getpid()}.partial").symlink_to(precious)
    (folder / "out.txt").symlink_to(precious)
    write_text(folder / "out.txt", "ours")
    assert (folder / "out.txt").read_text() == "ours"
    (folder / "lock").symlink_to(precious)
    with pytest.raises(OSError, match="symbolic links"):
        open_own(folder / "lock", os.O_RDWR | os.O_TRUNC)
    assert precious.read_text() == "mine"
    (folder / "runs").symlink_to(tmp_path)
    with pytest.raises(RecordError, match="runs: is a link"):
        own_folder(folder / "runs")
    assert own_folder(folder / "own") == own_folder(folder / "own")


@pytest.mark.parametrize("name", ["pipe", "link", "folder"])
def test_only_a_regular_file_is_read(tmp_path, name):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("/etc/hostname")
    (tmp_path / "folder").mkdir()
    with pytest.raises(RecordError, match=name):
        read_bounded(tmp_path / name, 100)


def test_what_is_read_has_bounds(tmp_path):
    (tmp_path / "file").write_bytes(b"12345")
    assert read_bounded(tmp_path / "file", 5) == b"12345"
    with pytest.raises(RecordError, match="at most 4 bytes, got 5"):
        read_bounded(tmp_path / "file", 4)
    packed = zlib.compress(bytes(1 << 20))
    assert inflate(packed, 1 << 20) == bytes(1 << 20)
    for damaged, limit, problem in (
        (packed, (1 << 20) - 1, "at most"),
        (packed[:-8], 1 << 21, "truncated"),
        (b"no", 9, "header"),
    ):
        with pytest.raises(ValueError, match=problem):
            inflate(damaged, limit)
    os.mkfifo(tmp_path / "pipe")
    assert file_digest(tmp_path / "pipe") == file_digest("/dev/zero") == ""


def test_a_table_that_inflates_beyond_bounds_is_not_read(tmp_path):
    table = pa.table({"x": pa.array([0]).take(pa.array([0] * 1000))})
    write_parquet(tmp_path / "table.parquet", table)
    with mock.patch("mavfi_cli.core.files._LARGEST", 4000), pytest.raises(RecordError, match="MB"):
        read_parquet(tmp_path / "table.parquet", "table")
    assert read_parquet(tmp_path / "table.parquet", "table").num_rows == 1000


@pytest.mark.parametrize("text", ["", "[" * 100_000, "[1]", "5", '{"a": '])
def test_what_is_no_json_object_is_refused(tmp_path, text):
    path = tmp_path / "plan.json"
    path.write_text(text)
    with pytest.raises(RecordError, match=r"plan\.json: (damaged|not a JSON object)"):
        read_json(path, 1 << 20)
    path.write_text('{"a": 5}')
    assert read_json(path, 1 << 20) == {"a": 5}
