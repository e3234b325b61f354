"""The detector that docs/detect.md shows, installed as a package is, fulfils the contract."""

import os
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_the_detector_of_the_documentation_passes_the_contract_suite(tmp_path):
    document = (ROOT / "docs" / "detect.md").read_text()
    source, own_test = re.findall(r"^```python\n(.*?)^```$", document, re.DOTALL | re.M)
    (entry,) = re.findall(
        r'^\[project\.entry-points\."mavfi\.detectors"\]\n(\w+) = "my_package\.(\w+):(\w+)"$',
        document, re.M,
    )  # fmt: skip
    assert len(source.splitlines()) <= 35
    name, module, factory = entry
    package = tmp_path / "my_package"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / f"{module}.py").write_text(source)
    metadata = tmp_path / "my_package-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: my_package\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(
        f"[mavfi.detectors]\n{name} = my_package.{module}:{factory}\n"
    )
    (tmp_path / "test_mine.py").write_text(own_test)
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-c", os.devnull,
         tmp_path / "test_mine.py"],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(tmp_path)}, check=False,
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert int(re.search(r"(\d+) passed", done.stdout)[1]) > 60
