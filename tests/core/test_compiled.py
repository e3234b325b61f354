"""The cache of machine code: used when nothing changed, dropped when a callee did."""

import subprocess
import sys

CALLEE = (
    "from mavfi_cli.core.compiled import compiled\n@compiled\ndef inner(x):\n    return x + {}\n"
)
CALLER = (
    "from mavfi_cli.core.compiled import compiled\n"
    "from callee_module import inner\n"
    "@compiled\n"
    "def outer(x):\n"
    "    return inner(x)\n"
    "from mavfi_cli.core.compiled import in_cache\n"
    "known = in_cache(outer)\n"
    "print(outer(1.0), sum(outer.stats.cache_hits.values()), known)\n"
)


def test_an_edited_callee_is_compiled_anew(tmp_path, monkeypatch):
    (tmp_path / "caller_module.py").write_text(CALLER)
    monkeypatch.setenv("PYTHONPATH", ":".join([str(tmp_path), *sys.path]))

    def run():
        command = [sys.executable, "-c", "import caller_module"]
        result = subprocess.run(command, capture_output=True, text=True, check=True, cwd=tmp_path)
        return result.stdout.split()

    (tmp_path / "callee_module.py").write_text(CALLEE.format(1.0))
    assert run() == ["2.0", "0", "False"]
    assert run() == ["2.0", "1", "True"]
    (tmp_path / "callee_module.py").write_text(CALLEE.format(5.0))
    assert run() == ["6.0", "0", "False"]
