import subprocess
import sys

import pytest

from mavfi_cli import cli


@pytest.fixture
def command_line(monkeypatch, capfd, tmp_path):
    """Run the command line in this process, in an empty folder; exit code, stdout, stderr."""
    monkeypatch.chdir(tmp_path)
    # A command that becomes another process would take the test's own with it.
    monkeypatch.setattr("os.execv", lambda _path, line: sys.exit(subprocess.call(line)))

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["mavfi", *map(str, arguments)])
        capfd.readouterr()
        with pytest.raises(SystemExit) as left:
            cli.main()
        out, err = capfd.readouterr()
        return left.value.code, out, err

    return run
