"""The package: what is installed flies from an empty folder, the source archive is whole."""

import os
import shutil
import subprocess
import sys
import tarfile
import tomllib
from pathlib import Path

import pytest
import yaml

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


@pytest.mark.slow
def test_what_is_installed_flies_from_an_empty_folder(source, tmp_path):
    """With worlds, vehicles, platforms, stacks, presets and models of the wheel alone."""
    installed, empty = tmp_path / "installed", tmp_path / "empty"
    empty.mkdir()
    offline = ("--no-deps", "--no-build-isolation", "--no-index", "--target", installed)
    run("-m", "pip", "install", "-q", *offline, source, cwd=empty)
    mavfi = ("-m", "mavfi_cli")
    path = {"PYTHONPATH": str(installed)}
    assert str(installed) in run("-c", "import sitl; print(sitl.__file__)", cwd=empty, **path)
    flight = (*mavfi, "fly", "--world", "farm", "--detector", "aad", "--platform", "tx2")
    assert "SUCCESS" in run(*flight, cwd=empty, **path)
    for line in (("stacks",), ("world", "list"), ("campaign", "plan", "fig9"), ("vpm",)):
        run(*mavfi, *line, cwd=empty, **path)


@pytest.mark.slow
def test_the_source_archive_has_the_documents(source, tmp_path):
    name = run("-c", SDIST, tmp_path, cwd=source).splitlines()[-1]
    with tarfile.open(tmp_path / name) as archive:
        found = {member.partition("/")[2] for member in archive.getnames()}
    wanted = {"README.md", "CITATION.cff", "Containerfile", "constraints.txt", "docs/conf.py"}
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


def test_the_shell_completes_options():
    asked = {"_MAVFI_COMPLETE": "bash_complete", "COMP_WORDS": "mavfi fly --wo", "COMP_CWORD": "2"}
    assert "plain,--world\n" in run(Path(sys.executable).parent / "mavfi", cwd=ROOT, **asked)
