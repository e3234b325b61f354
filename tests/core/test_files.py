import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from mavfi_cli.core.errors import RecordError
from mavfi_cli.core.files import ScratchFolder, folder_digest, write_text
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
