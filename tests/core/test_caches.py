"""Where numba and matplotlib keep their caches, by what the user may write."""

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from mavfi_cli.core import compiled
from mavfi_cli.core.compiled import PACKAGE

VARIABLES = ("NUMBA_CACHE_DIR", "MPLCONFIGDIR")


@pytest.fixture
def chosen(tmp_path, monkeypatch):
    """Choose caches where these folders cannot be written; the variables, by name."""
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.delitem(sys.modules, "numba", raising=False)
    for name in (*VARIABLES, "XDG_CACHE_HOME", "XDG_CONFIG_HOME"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    (tmp_path / "home").mkdir()

    def choose(*unwritable):
        def access(path, _mode):
            return not any(Path(path).is_relative_to(each) for each in unwritable)

        monkeypatch.setattr("os.access", access)
        compiled.choose_caches.__wrapped__()
        return [os.environ.get(name) for name in VARIABLES]

    return choose


def test_they_stay_where_they_are_if_that_can_be_written(chosen):
    assert chosen() == [None, None]


def test_another_users_installation_has_them_at_home(chosen, tmp_path):
    assert chosen(PACKAGE) == [str(tmp_path / "home/.cache/mavfi"), None]


def test_the_users_own_choice_stays(chosen, tmp_path, monkeypatch):
    own = [str(tmp_path / name) for name in ("machine-code", "fonts")]
    for name, folder in zip(VARIABLES, own, strict=True):
        monkeypatch.setenv(name, folder)
    assert chosen(PACKAGE, tmp_path / "home") == own


def test_without_any_other_they_are_temporary_and_private_and_said_once(chosen, tmp_path, capsys):
    folder = tmp_path / f"mavfi-{os.getuid()}"
    expected = [str(folder), str(folder / "matplotlib")]
    assert chosen(PACKAGE, tmp_path / "home") == expected
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"caches are in {folder}: neither ")
    assert chosen(PACKAGE, tmp_path / "home") == expected
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("mine", ["link", "writable for all", "file"])
def test_what_others_put_at_that_place_is_not_used(chosen, tmp_path, capsys, mine):
    folder = tmp_path / f"mavfi-{os.getuid()}"
    if mine == "link":
        (tmp_path / "theirs").mkdir(mode=0o700)
        folder.symlink_to(tmp_path / "theirs")
    elif mine == "file":
        folder.write_text("")
    else:
        folder.mkdir()
        folder.chmod(0o777)
    code, _ = chosen(PACKAGE, tmp_path / "home")
    assert Path(code).parent == tmp_path
    assert Path(code) != folder
    assert str(code) in capsys.readouterr().err


def test_functions_compile_where_nothing_beside_the_sources_can_be_written(tmp_path):
    code = (
        "import os, pathlib; from mavfi_cli.core.compiled import PACKAGE\n"
        "access = os.access\n"
        "os.access = lambda path, mode: PACKAGE not in [path, *pathlib.Path(path).parents] "
        "and access(path, mode)\n"
        "from mavfi_cli.detect import baselines\n"
        "print(baselines._norm._cache.cache_path)\n"
    )
    environment = {name: value for name, value in os.environ.items() if name not in VARIABLES}
    environment |= {"XDG_CACHE_HOME": str(tmp_path), "NUMBA_DISABLE_JIT": "0"}
    line = [sys.executable, "-c", code]
    done = subprocess.run(line, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.startswith(str(tmp_path / "mavfi"))
