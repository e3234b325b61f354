"""The cache of machine code: used when nothing changed, dropped when a callee did."""

import platform
import subprocess
import sys

import numpy as np
import pytest

from mavfi_cli.core.compiled import TARGET, compiled, processor_level

CALLEE = (
    "from mavfi_cli.core.compiled import compiled\n@compiled\ndef inner(x):\n    return x + {}\n"
)
BETWEEN = (
    "from mavfi_cli.core.compiled import compiled\n"
    "from callee_module import inner\n"
    "@compiled\n"
    "def between(x):\n"
    "    return inner(x)\n"
)
CALLER = (
    "from mavfi_cli.core.compiled import compiled\n"
    "from between_module import between\n"
    "@compiled\n"
    "def outer(x):\n"
    "    return between(x)\n"
    "from mavfi_cli.core.compiled import in_cache\n"
    "known = in_cache(outer)\n"
    "print(outer(1.0), sum(outer.stats.cache_hits.values()), known)\n"
)


@pytest.fixture
def chain(tmp_path, monkeypatch):
    """Three modules in folders of their own, and what a run of the first prints."""
    folders = [tmp_path / name for name in ("caller", "between", "callee")]
    texts = (CALLER, BETWEEN, CALLEE.format(1.0))
    for folder, text in zip(folders, texts, strict=True):
        folder.mkdir()
        (folder / f"{folder.name}_module.py").write_text(text)
    monkeypatch.setenv("PYTHONPATH", ":".join([*map(str, folders), *sys.path]))

    def run():
        command = [sys.executable, "-c", "import caller_module"]
        result = subprocess.run(command, capture_output=True, text=True, check=True, cwd=tmp_path)
        return result.stdout.split()

    return tmp_path, run


@pytest.mark.slow
def test_an_edited_callee_of_a_callee_is_compiled_anew(chain):
    folder, run = chain
    assert run() == ["2.0", "0", "False"]
    assert run() == ["2.0", "1", "True"]
    (folder / "callee" / "callee_module.py").write_text(CALLEE.format(5.0))
    assert run() == ["6.0", "0", "False"]


@pytest.mark.slow
def test_machine_code_from_the_cache_needs_no_compiler():
    script = (
        "import sys; from mavfi_cli.autonomy.warm import warm_up; "
        "warm_up(); print('numba.typed.typeddict' in sys.modules)"
    )
    command = [sys.executable, "-c", script]
    for _ in range(2):  # the first may fill the cache
        result = subprocess.run(command, capture_output=True, text=True, check=True)
    assert result.stdout == "False\n"


@pytest.mark.skipif(platform.machine() != "x86_64", reason="levels are those of x86-64")
def test_the_level_of_the_processor_agrees_with_numpy():
    features = np._core._multiarray_umath.__cpu_features__
    assert (processor_level() >= "x86-64-v3") == (features["AVX2"] and features["FMA3"])
    assert (processor_level() == "x86-64-v4") == features["AVX512_SKX"]


@pytest.mark.skipif(processor_level() < TARGET, reason="kernels are compiled for the processor")
def test_kernels_have_the_same_instructions_on_every_processor():
    @compiled
    def scale(values, factor):
        for i in range(len(values)):
            values[i] *= factor

    scale(np.ones(64), 2.0)
    scale.recompile()  # code from the cache cannot be inspected
    code = "".join(scale.inspect_asm().values())
    assert "ymm" in code
    assert "zmm" not in code


@pytest.mark.slow
def test_damaged_machine_code_is_compiled_anew(chain):
    folder, run = chain
    assert run() == ["2.0", "0", "False"]
    cache = folder / "caller" / "__pycache__"
    for pattern in ("*.nbi", "*.nbc"):
        for file in cache.glob(pattern):
            file.write_bytes(file.read_bytes()[:40] + b"damage")
        assert run()[:2] == ["2.0", "0"]
        assert run() == ["2.0", "1", "True"]
