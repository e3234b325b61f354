"""The package: what is installed flies from an empty folder, the source archive is whole."""

import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
from pathlib import Path

import pytest
import yaml
from missions import SHORT_LINE

import mavfi_cli

ROOT = Path(__file__).parents[1]
SDIST = "import sys; from setuptools.build_meta import build_sdist; print(build_sdist(sys.argv[1]))"


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A copy of the sources, in which a build may leave its files."""
    folder = tmp_path_factory.mktemp("source") / "mavfi"
    left_out = shutil.ignore_patterns(".*", "build", "runs", "campaigns", "*.egg-info")
    shutil.copytree(ROOT, folder, ignore=left_out)
    return folder


def run(*line, cwd, **environment):
    done = subprocess.run(
        [sys.executable, *line], cwd=cwd, env=os.environ | environment, check=False,
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


FLIGHT = """
import json, sys
from numba.core import event
import mavfi_cli as mavfi
from mavfi_cli.mission import vehicle

class Late(event.Listener):
    kernels = []
    def on_start(self, told):
        self.kernels.append(told.data["dispatcher"].py_func.__name__)
    def on_end(self, told):
        pass

def opened(*given, **options):
    event.register("numba:compile", Late())
    return real(*given, **options)

real, vehicle.open_transport = vehicle.open_transport, opened
link, detector = sys.argv[1:]
run = mavfi.fly(link=link, detector={"name": detector}, goal=(8.0, 4.0, 5.0), stack="hardened")
unused = [name for name, node in run.result["kernels"].items() if not node["invocations"]]
print(json.dumps({"unused": unused, "late": Late.kernels}))
"""


@pytest.mark.slow
def test_what_is_installed_flies_from_an_empty_folder(source, start_sitl, tmp_path):
    """With worlds, vehicles, platforms, stacks, presets and models of the wheel alone.

    Its first flight compiles everything before the link opens. The second finds what the first has
    compiled, but not the kernels of its detector.
    """
    installed, empty, cache = tmp_path / "installed", tmp_path / "empty", tmp_path / "cache"
    empty.mkdir()
    offline = ("--no-deps", "--no-build-isolation", "--no-index", "--target", installed)
    run("-m", "pip", "install", "-q", *offline, source, cwd=empty)
    mavfi = ("-m", "mavfi_cli")
    path = {"PYTHONPATH": str(installed), "NUMBA_CACHE_DIR": str(cache)}
    assert str(installed) in run("-c", "import sitl; print(sitl.__file__)", cwd=empty, **path)
    compiled = set()
    for detector in ("gad", "aad"):
        with start_sitl() as link:
            flown = run("-c", FLIGHT, link, detector, cwd=empty, **path)
        assert json.loads(flown.splitlines()[-1]) == {"unused": [], "late": []}
        assert {*cache.rglob("*.nbc")} > compiled
        compiled = {*cache.rglob("*.nbc")}
    flight = (*mavfi, *SHORT_LINE, "--detector", "aad", "--platform", "tx2")
    assert "SUCCESS" in run(*flight, cwd=empty, **path)
    for line in (("stacks",), ("world", "list"), ("campaign", "plan", "fig9"), ("vpm",)):
        run(*mavfi, *line, cwd=empty, **path)


@pytest.mark.slow
def test_the_source_archive_has_the_documents(source, tmp_path):
    name = run("-c", SDIST, tmp_path, cwd=source).splitlines()[-1]
    with tarfile.open(tmp_path / name) as archive:
        found = {member.partition("/")[2] for member in archive.getnames()}
    wanted = {
        "action.yml",
        "README.md",
        "CITATION.cff",
        "Containerfile",
        "constraints.txt",
        "docs/conf.py",
    }
    wanted |= {str(each.relative_to(source)) for each in source.glob("docs/**/*.md")}
    assert wanted <= found


def test_the_page_of_the_installation_names_every_extra():
    page = (ROOT / "docs" / "how-to" / "install.md").read_text()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert [name for name in project["optional-dependencies"] if f"| `{name}` |" not in page] == []


def test_the_citation_is_of_this_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == mavfi_cli.__version__
    assert citation["cff-version"] == "1.2.0"


def test_zenodo_and_the_citation_say_the_same():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    zenodo = json.loads((ROOT / ".zenodo.json").read_text())
    for key in ("title", "version", "license", "keywords"):
        assert zenodo[key] == citation[key], key
    assert zenodo["upload_type"] == citation["type"] == "software"
    assert zenodo["creators"] == citation["authors"]
    papers = [each["identifier"] for each in zenodo["related_identifiers"]]
    assert papers == [each["doi"] for each in citation["references"]]


@pytest.fixture(scope="module")
def engine():
    """A container engine that works on this machine."""
    for name in ("podman", "docker"):
        asked = [name, "info"]
        if shutil.which(name) and subprocess.run(asked, capture_output=True).returncode == 0:
            return name
    return pytest.skip("neither podman nor docker works on this machine")


@pytest.mark.slow
def test_the_image_is_built_and_flies(engine, source, tmp_path):
    """As docs/how-to/install.md says."""
    image, mine = "mavfi-test", ["--user", f"{os.getuid()}:{os.getgid()}"]
    mine = ["--userns=keep-id"] if engine == "podman" else mine
    flight = [image, "fly", "--world", "farm", "--expect", "success"]
    for line in (
        ["build", "-q", "-t", image, "-f", "Containerfile", "."],
        ["run", "--rm", *mine, "-v", f"{tmp_path}:/work", *flight],
    ):
        done = subprocess.run([engine, *line], cwd=source, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
    assert "SUCCESS" in done.stdout
    assert (tmp_path / "runs" / "farm-3-001" / "result.json").is_file()


ACTION = yaml.safe_load((ROOT / "action.yml").read_text())
STEPS = {step["name"]: step for step in ACTION["runs"]["steps"] if "run" in step}


def test_the_action_is_whole():
    """Every input is used and described on its page, and none is pasted into a script."""
    assert ACTION["runs"]["using"] == "composite"
    text = (ROOT / "action.yml").read_text()
    assert {*re.findall(r"\$\{\{ inputs\.([\w-]+) \}\}", text)} == {*ACTION["inputs"]}
    page = (ROOT / "docs" / "how-to" / "ci.md").read_text()
    assert [name for name in ACTION["inputs"] if f"| `{name}` |" not in page] == []
    assert all(each["description"] for each in ACTION["inputs"].values())
    for step in STEPS.values():
        assert step["shell"] == "bash"
        assert "${{" not in step["run"]


def run_step(name, folder, programs, **environment):
    """Run a step as GitHub does, with these programs in the environment that it makes."""
    made = folder / "mavfi" / "bin"
    made.mkdir(parents=True, exist_ok=True)
    for program, text in programs.items():
        (made / program).write_text(text)
        (made / program).chmod(0o755)
    shell = ["bash", "--noprofile", "--norc", "-e", "-o", "pipefail", "-c", STEPS[name]["run"]]
    more = {"RUNNER_TEMP": str(folder), "GITHUB_ACTION_PATH": str(ROOT), **environment}
    return subprocess.run(
        shell, cwd=folder, env=os.environ | more, check=False, capture_output=True, text=True
    )


def test_the_action_installs_with_the_constraints(tmp_path):
    python, told = tmp_path / "python", '#!/bin/sh\nfor each; do echo "$each"; done\n'
    python.write_text(told)
    python.chmod(0o755)
    path = f"{tmp_path}{os.pathsep}{os.environ['PATH']}"
    for extras, package in (("", f"{ROOT}"), ("report,mcap", f"{ROOT}[report,mcap]")):
        done = run_step("Install mavfi", tmp_path, {"pip": told}, PATH=path, EXTRAS=extras)
        assert done.returncode == 0, done.stderr
        words = ["install", "--quiet", "--constraint", f"{ROOT}/constraints.txt", package]
        assert done.stdout.splitlines() == ["-m", "venv", f"{tmp_path}/mavfi", *words]


def test_the_action_ends_with_the_first_command_that_fails(tmp_path):
    mavfi = {"mavfi": f'#!/bin/sh\nexec {sys.executable} -m mavfi_cli "$@"\n'}
    commands = "\n# a comment\nplatforms x86\nshow 'no such folder; touch harm' \n--version\n"
    done = run_step("Run mavfi", tmp_path, mavfi, COMMANDS=commands)
    assert done.returncode != 0
    assert done.stdout.startswith("mavfi platforms x86\nx86")
    assert "error: no such folder; touch harm: " in done.stderr
    assert "--version" not in done.stdout
    assert not (tmp_path / "harm").exists()
    assert run_step("Run mavfi", tmp_path, mavfi, COMMANDS="--version").returncode == 0


@pytest.mark.slow
def test_the_action_fails_on_another_outcome_than_the_expected_one(tmp_path):
    mavfi = {"mavfi": f'#!/bin/sh\nexec {sys.executable} -m mavfi_cli "$@"\n'}
    flight = f"{' '.join(SHORT_LINE)} --quiet --no-picture --expect"
    assert run_step("Run mavfi", tmp_path, mavfi, COMMANDS=f"{flight} success").returncode == 0
    done = run_step("Run mavfi", tmp_path, mavfi, COMMANDS=f"{flight} collision")
    assert done.returncode != 0
    assert "error: expected collision, got SUCCESS" in done.stderr


def test_the_shell_completes_options():
    asked = {"_MAVFI_COMPLETE": "bash_complete", "COMP_WORDS": "mavfi fly --wo", "COMP_CWORD": "2"}
    assert "plain,--world\n" in run(Path(sys.executable).parent / "mavfi", cwd=ROOT, **asked)
