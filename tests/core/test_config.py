import tomllib
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from mavfi_cli.core.config import load_toml, toml_text
from mavfi_cli.core.errors import ConfigError


@dataclass(frozen=True)
class Inner:
    a: float
    b: int = 1


@dataclass(frozen=True)
class Outer:
    name: str
    box: list[Inner]
    sub: Inner | None = None
    pair: tuple[float, float] = (0.0, 0.0)
    named: dict[str, Inner] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.name == "bad":
            raise ValueError("a bad name")


def load(tmp_path: Path, text: str) -> Outer:
    path = tmp_path / "file.toml"
    path.write_text(text)
    return load_toml(path, Outer)


def test_a_good_file(tmp_path):
    text = 'name = "x"\npair = [1, 2.5]\n[[box]]\na = 1\n[sub]\na = 2.0\nb = 3\n[named.one]\na = 4'
    expected = Outer("x", [Inner(1.0)], Inner(2.0, 3), (1.0, 2.5), {"one": Inner(4.0)})
    assert load(tmp_path, text) == expected


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('name = "x"\nbox = []\nnam = 1', r"file\.toml:3: nam: .*'name'"),
        ('name = "x"\n[[box]]\na = 1\n[[box]]\nq = 2', r"file\.toml:5: box\[1\]\.q: "),
        ('name = "x"\nbox = []\n[named.one]\nq = 2', r"file\.toml:4: named\.one\.q: "),
    ],
)
def test_an_unknown_key_names_the_nearest(tmp_path, text, message):
    with pytest.raises(ConfigError, match=message):
        load(tmp_path, text)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name = 3\nbox = []", r"file\.toml:1: name: .*text, got 3"),
        ('name = "x"\n[[box]]\na = "k"', r"file\.toml:3: box\[0\]\.a: .*number, got 'k'"),
        (
            'name = "x"\n[[box]]\na = 1\n[[box]]\na = "k"',
            r"file\.toml:5: box\[1\]\.a: .*number, got 'k'",
        ),
        ('name = "x"\n[[box]]\na = 1\n[[box]]\nb = 1', r"file\.toml:4: box\[1\]\.a: is missing"),
        ('name = "x"\nbox = []\npair = [1]', r"file\.toml:3: pair: .*2 values, got 1"),
        ('name = "x"\nbox = []\npair = [1, true]', r"pair\[1\]: .*number, got True"),
        ('name = "x"\n[[box]]\na = nan', "finite number"),
        ('name = "x"\nbox = []\n[sub]\nb = 1', r"sub\.a: is missing"),
        ('name = "x"', "box: is missing"),
        ("box = []\nname = = 3", r"file\.toml:2: Invalid value \(column 8\)$"),
        ('name = "x', r"file\.toml: "),
        ('name = "x"\nbox = []\n[named.one]\na = "k"', r"file\.toml:4: named\.one\.a: "),
        ('name = "bad"\nbox = []', "a bad name"),
        ('name = "x"\nbox = []\nsub = 3', r"file\.toml:3: sub: .*table, got 3$"),
        ('name = "x"\nbox = []\nsub = ["a"]', r"sub: .*table, got \['a'\]$"),
        ('name = "x"\nbox = []\nnamed = 3', r"named: .*table, got 3$"),
        (
            'name = "x"\nbox = []\n[named]\none = 0.3',
            r":4: named\.one: .*table, got 0\.3$",
        ),
        ('name = "x"\nbox = []\n[[named.one]]\na = 1', r"named\.one: .*table, got \["),
        ('name = "x"\nbox = 3', r"file\.toml:2: box: .*array, got 3$"),
        ('name = "x"\nbox = [3]', r"file\.toml:2: box\[0\]: .*table, got 3$"),
        ('name = "x"\nbox = []\npair = "12"', r"file\.toml:3: pair: .*array, got '12'$"),
    ],
)
def test_what_is_wrong_is_said_with_file_line_and_key(tmp_path, text, message):
    with pytest.raises(ConfigError, match=message) as error:
        load(tmp_path, text)
    assert "\n" not in str(error.value)


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(ConfigError, match="No such file"):
        load_toml(tmp_path / "none.toml", Outer)


def test_a_file_that_is_no_text(tmp_path):
    (tmp_path / "file.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="UTF-8"):
        load_toml(tmp_path / "file.toml", Outer)


def test_what_is_written_as_toml_reads_back_equal():
    values = {
        "name": 'odd "text" \\ \x7f \x1b é',
        "whole": 3,
        "tiny": 5e-324,
        "truth": True,
        "rows": [[1.5, 2.0], []],
        "sub": {"a b": 1, "deep": {"x": {"y": "z"}}},
        "box": [{"a": 1.0, "in": {"b": 2}}, {"a": 3.0}],
    }
    assert tomllib.loads(toml_text({**values, "empty": {}})) == values
