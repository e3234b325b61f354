"""The rules of the house that a type checker and the import contracts cannot hold."""

import ast
import functools
import graphlib
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[1]
SOURCES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for package in ("mavfi_cli", "sitl")
    for path in sorted((ROOT / package).rglob("*.py"))
}
LONGEST_CHAIN = 14  # modules, each of which imports the next, wherever the import stands
MOST_FILES = 264
MOST_NAMES = 995  # public classes and functions at the top level; a row of results is a class
# Functions that nothing in the product calls by name, with the reason to keep them.
UNCALLED = {
    "__getattr__": "Python calls it: names of the library are imported when they are first used",
    "__dir__": "Python calls it: completion of the library's names",
    "list_commands": "click calls it",
    "get_command": "click calls it",
    "format_commands": "click calls it",
    "format_options": "click calls it",
    "checkMotion": "OMPL calls it",
    "find_class": "pickle calls it",
    "library_scope": "for kernels of users (docs/how-to/kernel.md)",
}
# Rooms whose numbers reach a mission, a fault's draw or the model; training is none of them.
FLOWN = (
    "core",
    "autonomy",
    "companion",
    "detect",
    "fi",
    "link",
    "spec",
    "attack",
    "mission",
    "vpm",
)
TRAINING = ("mavfi_cli.detect.fit", "mavfi_cli.detect.offline")
# Functions of numpy whose last digit depends on the processor: it has versions for AVX-512 of the
# first (numpy/_core/src/umath), and gives the second to BLAS. Equal elements come in the order of
# the third, unless it is stable. `math`, compiled kernels and `np.hypot` call libm, and norms
# along an axis add squares up, without BLAS.
BY_PROCESSOR = re.compile(
    r"np\.(?:random\.)?(a?(sin|cos|tan)h?|arc(sin|cos|tan)h?|arctan2|exp2?|expm1|log(2|10|1p)?|power"
    r"|float_power|cbrt|logspace|geomspace|sinc|v?dot|inner|matmul|tensordot|einsum|convolve"
    r"|correlate|cov|corrcoef|linalg(?!\.norm\(.*axis=)|polyfit|arg(sort|partition)(?!.*stable)"
    r"|partition)\b"
)
COMMANDS = ("mavfi_cli/cli/",)  # functions that click calls by decorator


@functools.cache
def tree(module):
    return ast.parse(SOURCES[module].read_text())


@functools.cache
def imports(module):
    """Our modules that a module imports, also inside a function or for type checkers only."""
    found = set()
    for statement in ast.walk(tree(module)):
        if isinstance(statement, ast.Import):
            found |= {each.name for each in statement.names}
        elif isinstance(statement, ast.ImportFrom):
            names = {f"{statement.module}.{each.name}" for each in statement.names}
            found |= {name if name in SOURCES else statement.module for name in names}
    return found & SOURCES.keys() - {module}


def mentions(pattern, room=""):
    """Modules outside a room whose code has the pattern."""
    expression = re.compile(pattern, re.MULTILINE)
    return {
        module for module, path in SOURCES.items()
        if not (room and module.startswith(room)) and expression.search(path.read_text())
    }  # fmt: skip


def test_a_public_class_name_exists_once():
    names = Counter(
        statement.name
        for module in SOURCES
        for statement in tree(module).body
        if isinstance(statement, ast.ClassDef) and not statement.name.startswith("_")
    )
    assert [name for name, count in names.items() if count > 1] == []


def test_the_house_stays_small():
    names = [
        statement.name
        for module in SOURCES
        for statement in tree(module).body
        if isinstance(statement, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        and not statement.name.startswith("_")
    ]
    assert len(names) <= MOST_NAMES
    assert len(SOURCES) <= MOST_FILES


def test_imports_have_no_circle_and_only_short_chains():
    """`graphlib` raises CycleError with the modules of a circle."""
    chains = {}
    graph = {module: imports(module) for module in SOURCES}
    for module in graphlib.TopologicalSorter(graph).static_order():
        behind = max((chains[each] for each in imports(module)), key=len, default=())
        chains[module] = (module, *behind)
    longest = max(chains.values(), key=len)
    assert len(longest) <= LONGEST_CHAIN, longest


def test_one_module_forks():
    forking = mentions(r"\bos\.fork(pty)?\b|get_context\(\"fork")
    assert {module.rpartition(".")[2] for module in forking} == {"processes"}


def test_tables_csv_and_pictures_are_made_in_report_only():
    made = (
        r"^\s*(import csv|from csv|from pyarrow import .*csv|from rich\.table|.*import.*matplotlib)"
    )
    assert mentions(made, room="mavfi_cli.report") == {"sitl.world.plan"}  # the vehicle's own
    assert mentions(r"report\.columns import", room="mavfi_cli.report") <= {
        "mavfi_cli.cli.inventory"
    }


def test_the_command_line_holds_no_data():
    assert {name for name in mentions(r"@dataclass") if name.startswith("mavfi_cli.cli")} == set()


def test_every_public_function_has_a_caller():
    told = subprocess.run(
        [sys.executable, "-m", "vulture", "mavfi_cli", "sitl", "--min-confidence", "60"],
        capture_output=True, text=True, cwd=ROOT, check=False,
    )  # fmt: skip
    uncalled = re.findall(
        r"^(\S+):\d+: unused (?:function|method|property|class) '(\w+)'", told.stdout, re.M
    )
    assert uncalled, told.stderr
    public = {(path, name) for path, name in uncalled if not re.match("_[a-z]", name)}
    dead = {name for path, name in public if not path.startswith(COMMANDS)}
    listed = {name for _, name in uncalled}
    assert dead - UNCALLED.keys() == set()
    assert UNCALLED.keys() - listed == set()  # no reason for what has a caller


def test_a_record_is_read_in_one_module():
    """Others take sections and measures from `mission.measures`."""
    reads = r"\bresult(\[|\.get\()[\"']"
    here = "mavfi_cli.mission.measures"
    assert mentions(reads) == {here, "mavfi_cli.mission.run_folder"}  # it upgrades older records


def by_processor(module):
    """Calls of a module whose last digit depends on the processor."""
    inside = [
        node
        for each in ast.walk(tree(module))
        if isinstance(each, ast.FunctionDef)
        and any(ast.unparse(name) == "compiled" for name in each.decorator_list)
        for node in ast.walk(each)
    ]
    for node in ast.walk(tree(module)):
        called = ast.unparse(node) if isinstance(node, ast.Call) and node not in inside else ""
        product = isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult)
        if product or BY_PROCESSOR.match(called):
            yield ast.unparse(node)


def test_no_last_digit_of_a_mission_depends_on_the_processor():
    rooms = [f"mavfi_cli.{room}." for room in FLOWN] + ["sitl."]
    flown = [m for m in SOURCES if f"{m}.".startswith(tuple(rooms)) and m not in TRAINING]
    assert [(m, text) for m in flown for text in by_processor(m)] == []


def test_a_source_is_one_that_a_reader_can_find():
    """Notes that the repository does not hold are no source."""
    assert mentions(r"\bfacts, sections?\b|\b(design|style|libraries)\.md\b") == set()
