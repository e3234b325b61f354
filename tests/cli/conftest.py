import pytest


@pytest.fixture
def command_line(mavfi, monkeypatch, tmp_path):
    """Run the command line in an empty folder; exit code, stdout, stderr."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        done = mavfi(*arguments)
        return done.returncode, done.stdout, done.stderr

    return run
