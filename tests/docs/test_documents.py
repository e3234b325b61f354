"""The documents: commands run, examples work, links lead somewhere."""

import os
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from fake_autopilot import FakePX4

ROOT = Path(__file__).parents[2]
DOCUMENTS = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])


def blocks(document, language):
    return re.findall(rf"^```{language}\n(.*?)^```$", document.read_text(), re.DOTALL | re.M)


def commands():
    """Lines of the README's shell blocks that call mavfi."""
    lines = [line for block in blocks(ROOT / "README.md", "sh") for line in block.splitlines()]
    found = [shlex.split(line.replace(".venv/bin/", ""), comments=True) for line in lines]
    return [line[1:] for line in found if line[:1] == ["mavfi"]]


def named(*words):
    return [line for line in commands() if all(word in line for word in words)]


def example_world():
    (found,) = (b for b in blocks(ROOT / "docs/contributing.md", "toml") if "bounds_enu_m" in b)
    return found


# What takes long is done on a small scale: the same command with fewer flights.
SMALL = {
    "train": ["--flights", "3", "--kind", "l2"],
    "detect": ["--flights", "0", "--golden-flights", "1", "--detector", "none,gad"],
}


def test_the_readme_has_its_commands():
    assert {line[0] for line in commands()} == {"fly", "world", "sitl", "train", "detect"}


@pytest.mark.parametrize(
    "line", [c for c in commands() if c[0] != "sitl" and "--link" not in c], ids=" ".join
)
def test_a_command_of_the_readme_runs(line, mavfi, tmp_path):
    """The world of one's own is the example of docs/contributing.md; flights are cut short."""
    (example,) = (
        b for b in blocks(ROOT / "docs" / "contributing.md", "toml") if "bounds_enu_m" in b
    )
    (tmp_path / "my_world.toml").write_text(example)
    if line[0] == "fly" and "--expect" not in line:
        line = [*line, "--time-limit", "9", "--no-picture"]
    line = [*line, *SMALL.get(line[0], [])]
    done = mavfi(*line, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    if "--output" in line:
        assert (tmp_path / line[line.index("--output") + 1]).is_file()


def test_the_vehicle_alone(tmp_path, free_port):
    """With its onboard link on a free port, for others may fly on this machine."""
    (line,) = named("sitl")
    arguments = [*line, "--link", f"onboard=udpout:127.0.0.1:{free_port}"]
    process = subprocess.Popen(
        [sys.executable, "-m", "mavfi_cli", *arguments],
        stderr=subprocess.PIPE, text=True, cwd=tmp_path, start_new_session=True,
    )  # fmt: skip
    try:
        heard = []
        for told in process.stderr:
            heard.append(told)
            if told.startswith("Ctrl-C ends it"):
                break
    finally:
        os.killpg(process.pid, signal.SIGINT)
        process.communicate(timeout=30.0)
    assert heard[0].startswith("world farm ")
    assert any(f"MAVSDK    udpin://127.0.0.1:{free_port}" in told for told in heard)
    assert process.returncode == 0


def test_a_foreign_autopilot(mavfi, autopilot_on_udp, free_port, tmp_path):
    autopilot_on_udp(FakePX4())
    (line,) = named("--link")
    line = [word.replace("14540", str(free_port)) for word in line]
    done = mavfi(*line, "--time-limit", "1", "--no-land", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("TIMEOUT")


def test_the_example_world_is_checked_and_drawn(mavfi, tmp_path):
    (example,) = (
        b for b in blocks(ROOT / "docs" / "contributing.md", "toml") if "bounds_enu_m" in b
    )
    (tmp_path / "yard.toml").write_text(example)
    for command in ("check", "draw"):
        done = mavfi("world", command, "yard.toml", cwd=tmp_path)
        assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_relative_link_leads_to_a_file(document):
    text = re.sub(r"^```.*?^```$", "", document.read_text(), flags=re.DOTALL | re.M)
    targets = re.findall(r"\]\(([^)\s]+)\)", text)
    inside = [t.partition("#")[0] for t in targets if "://" not in t and not t.startswith("#")]
    missing = [target for target in inside if not (document.parent / target).exists()]
    assert missing == []


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_placeholder_is_left(document):
    assert "@@" not in document.read_text()


@pytest.mark.slow
def test_the_pages_build_without_a_warning(tmp_path):
    """A warning is a dead link, a page that no other lists, or a name that no longer exists."""
    line = ["-q", "-W", "--keep-going", "-b", "html", "-d", tmp_path / "cache", ROOT / "docs"]
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", *line, tmp_path / "pages"],
        capture_output=True, text=True, check=False, env={**os.environ, "PATH": path},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    commands = (tmp_path / "pages" / "reference" / "commands.html").read_text()
    assert "--fault-seed" in commands
    assert "--allow-unsigned" in commands  # of `mavfi sitl`, whose help is its own
