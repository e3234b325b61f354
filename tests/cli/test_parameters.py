"""Every option of every command: wrong values are usage errors, and the shell completes names."""

from dataclasses import fields

import click
import pytest
from click.shell_completion import ShellComplete

from mavfi_cli import cli, studies
from mavfi_cli.attack import campaign as attacks
from mavfi_cli.campaigns import begin, run
from mavfi_cli.cli.types import Name
from mavfi_cli.core.option_types import OutFile, OutFolder
from mavfi_cli.mission.flight import Flight
from mavfi_cli.paper import flying
from mavfi_cli.spec.mission import LIMITS
from mavfi_cli.studies import compare
from mavfi_cli.studies.compare import ComparePlan
from mavfi_cli.studies.evaluate import EvaluationPlan
from mavfi_cli.studies.redundancy import RedundancyPlan
from mavfi_cli.studies.train import TrainingPlan
from mavfi_cli.vpm.report import Choices

NUMBERS = (click.types.IntParamType, click.types.FloatParamType)
ABSURD = {"nan": "nan", "inf": "inf", "least": f"-{10**30}", "most": f"{10**30}"}


def _leaves(command, words=()):
    if not isinstance(command, click.Group):
        return [(words, command)]
    context = click.Context(command)
    return [
        leaf
        for name in command.list_commands(context)
        for leaf in _leaves(command.get_command(context, name), (*words, name))
    ]


def _options(kinds):
    """All options and arguments of some types, as parameters of a test."""
    return [
        pytest.param(words, param, id=" ".join([*words, param.opts[0]]))
        for words, command in _leaves(cli.cli)
        for param in command.params
        if isinstance(param.type, kinds)
    ]


@pytest.fixture
def refused(command_line, monkeypatch):
    """Run a command, which must end as wrong usage before it flies; its last line."""

    def accepted(*_arguments, **_options):
        raise AssertionError("the value was accepted")

    monkeypatch.setattr("mavfi_cli.autonomy.warm.is_compiled", lambda: True)  # else a line says so
    monkeypatch.setattr(Flight, "fly", accepted)
    for module in (attacks, begin):
        monkeypatch.setattr(module, "run_campaign", accepted)
    for module in (run, flying, studies, compare):
        monkeypatch.setattr(module, "fly_missing", accepted)

    def refuse(*line):
        code, out, err = command_line(*line)
        assert (code, out) == (2, ""), err
        *progress, said = err.splitlines()
        assert said.startswith("error: ")
        assert progress in ([], ["inputs: world no-such-name, seed 3"])
        return said

    return refuse


@pytest.mark.parametrize("value", ABSURD.values(), ids=ABSURD)
@pytest.mark.parametrize(("words", "param"), _options(NUMBERS))
def test_a_number_that_cannot_be_is_wrong_usage_of_its_option(refused, words, param, value):
    assert param.opts[-1] in refused(*words, f"{param.opts[-1]}={value}")


@pytest.mark.parametrize(("words", "param"), _options((click.Choice,)))
def test_a_choice_that_does_not_exist_is_wrong_usage_of_its_option(refused, words, param):
    assert param.opts[-1] in refused(*words, f"{param.opts[-1]}=no-such-choice")


@pytest.mark.parametrize(("words", "param"), _options((OutFile, OutFolder)))
def test_an_empty_path_to_write_is_wrong_usage(refused, words, param):
    needed = ["table4"] if words in {("campaign", "draw"), ("campaign", "export")} else []
    given = [""] if isinstance(param, click.Argument) else [f"{param.opts[-1]}="]
    assert refused(*words, *needed, *given).endswith(": the name is empty.")


BESIDES = {("campaign", "draw"): ["--output", "a.svg"], ("campaign", "export"): ["a.csv"]}
NEEDS = {  # options with which a name takes effect
    "--effect": ["--inject", "planning"],
    "--persistence": ["--inject", "planning"],
    "--field": ["--inject", "planning"],
    "--site": ["--level", "instruction", "--inject", "planning"],
    "--role": ["--level", "instruction", "--inject", "planning"],
    "--protect": ["--detector", "gad"],
    "--watch": ["--detector", "gad"],
}


@pytest.mark.parametrize(("words", "param"), _options((Name,)))
def test_a_name_that_does_not_exist_is_wrong_usage(refused, words, param):
    if isinstance(param, click.Argument):
        line = [*words, "no-such-name", *BESIDES.get(words, [])]
        assert "'no-such-name'" in refused(*line)
        return
    if words == ("campaign", "report"):
        pytest.skip("needs a campaign; tests/paper/test_status.py has one")
    option = param.opts[-1]
    needed = NEEDS.get(option, []) if words == ("fly",) else []
    assert option in refused(*words, f"{option}=no-such-name", *needed)


# Completion ---------------------------------------------------------------------------------------


@pytest.fixture
def completed(monkeypatch, tmp_path):
    """Complete the last word of a line in an empty folder; what the shell would offer."""
    monkeypatch.chdir(tmp_path)

    def complete(line):
        *words, incomplete = line.split(" ")
        shell = ShellComplete(cli.cli, {}, "mavfi", "_MAVFI_COMPLETE")
        return [item.value for item in shell.get_completions(words, incomplete)]

    return complete


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("st", ["stacks", "states"]),
        ("fly --world spa", ["sparse"]),
        ("fly --vehicle s", ["solo", "spark"]),
        ("fly --planner rrtc", ["rrtconnect"]),
        ("fly --platform x", ["x86"]),
        ("fly --stack mavbench-p", ["mavbench-protected"]),
        ("fly --stack mine", ["mine"]),  # the shell completes a path
        ("fly --detector ga", ["gad"]),
        ("fly --inject waypoint_p", ["waypoint_position"]),
        ("fly --inject oct", []),
        ("fly --level instruction --inject oct", ["octomap"]),
        ("fly --protect planning,con", ["planning,control"]),
        ("fly --site x", ["x87"]),
        ("fly --persistence st", ["stuck-at"]),
        ("detect evaluate --detector gad,a", ["gad,aad"]),
        ("campaign run table", ["table3", "table4"]),
        ("reproduce table5 fig1", ["fig11", "fig12", "fig13", "fig14", "fig15", "fig16"]),
        ("vpm --board xa", ["xavier"]),
        ("vpm --vehicle air", ["airsim"]),
        ("kernels --compat pinfi-", ["pinfi-bugs"]),
        ("world dr", ["draw"]),
        ("world draw far", ["farm"]),
        ("world draw --pa", ["--path"]),
        ("sitl --vehicle spa", []),
    ],
)
def test_the_shell_completes_names(completed, line, offered):
    assert completed(line) == offered


def test_the_shell_completes_run_folders_and_campaigns(completed, tmp_path):
    for folder in ("runs/farm-3-001", "runs/farm-3-002", "other"):
        (tmp_path / folder).mkdir(parents=True)
    for name in ("runs/farm-3-001", "runs/farm-3-002"):
        (tmp_path / name / "result.json").write_text("{}")
    (tmp_path / "campaigns" / "mine").mkdir(parents=True)
    (tmp_path / "campaigns" / "mine" / "ledger.sqlite").write_text("")
    assert completed("show ") == completed("replay run") == ["runs/farm-3-001", "runs/farm-3-002"]
    assert completed("view runs/farm-3-001") == ["runs/farm-3-001"]
    assert completed("campaign status camp") == ["campaigns/mine"]


@pytest.mark.parametrize("words", [("fly",), ("reproduce",)])
def test_never_is_the_longest_time_until_a_restart(words):
    (command,) = [command for known, command in _leaves(cli.cli) if known == words]
    given = command.make_context("mavfi", ["--restart", "never"]).params
    assert given["node_restart_s"] == LIMITS["node_restart_s"][1]


PLANS = [
    (("compare",), ComparePlan),
    (("detect", "evaluate"), EvaluationPlan),
    (("train",), TrainingPlan),
    (("vpm",), Choices),
    (("vpm",), RedundancyPlan),
]


@pytest.mark.parametrize(("words", "kind"), PLANS)
def test_a_plan_has_the_defaults_that_the_help_of_its_command_shows(words, kind):
    """A command passes only the options that the user gave."""
    (command,) = [command for known, command in _leaves(cli.cli) if known == words]
    shown = command.make_context("mavfi", [], resilient_parsing=True).params
    own = {field.name: field.default for field in fields(kind)}
    told = {name: shown[name] for name in own.keys() & shown.keys() if shown[name]}
    assert told
    assert {name: own[name] for name in told} == told


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("campaign plan --difference 0.5", "--discordant 0.2"),
        ("campaign run fig8 --out OUT --set wrld=x", "did you mean 'world'"),
        ("vpm --overhead aad=nan", "got nan"),
    ],
)
def test_a_wrong_value_within_an_option_is_wrong_usage(refused, tmp_path, line, words):
    assert words in refused(*line.replace("OUT", str(tmp_path / "out")).split())
