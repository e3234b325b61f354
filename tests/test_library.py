"""`import mavfi_cli as mavfi`: what a library's user gets."""

import base64
import json
import shutil
import subprocess
import sys
from html.parser import HTMLParser

import pytest
from pyarrow import parquet

import mavfi_cli as mavfi
from mavfi_cli import library
from mavfi_cli.core.errors import ConfigError, MavfiError

HEAVY = ("numba", "numpy", "torch", "pyarrow", "ompl", "fcl", "pymavlink", "click")


@pytest.fixture(name="mavfi_command")
def mavfi_command_fixture(request):
    """The command line; its fixture has the name of the library."""
    return request.getfixturevalue("mavfi")


@pytest.fixture(scope="module")
def flown_campaign(tmp_path_factory, short_config):
    folder = tmp_path_factory.mktemp("campaign")
    missions = [mavfi.PlannedMission(config=short_config, labels={"kind": "golden"})]
    mavfi.run_campaign(missions, folder).close()
    return folder


def test_the_import_loads_nothing_heavy():
    program = f"import sys, mavfi_cli; print([m for m in {HEAVY} if m in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout == "[]\n"


def test_every_name_is_there_and_others_are_not():
    for name in mavfi.__all__:
        assert getattr(mavfi, name) is not None
        assert name in dir(mavfi)
    with pytest.raises(AttributeError, match="no attribute 'flyy'"):
        mavfi.flyy  # noqa: B018


def test_settings_fly_what_the_configuration_flies(short_config, short_flight, tmp_path):
    flown = mavfi.fly(
        world="farm", seed=5, stack="hardened", start=(2, 2, 0), goal=(10, 6, 5), out=tmp_path
    )
    assert flown.trace.equals(mavfi.load_run(str(short_flight.path)).trace)
    assert flown.folder.path.parent == tmp_path


def test_a_configuration_and_settings_go_together(short_config, monkeypatch, tmp_path):
    flown = []

    class Flown(Exception):
        pass

    def fly_mission(config, out, watcher, **_):
        flown.append((config, out))
        raise Flown

    monkeypatch.setattr("mavfi_cli.mission.run.fly_mission", fly_mission)
    fault = mavfi.FaultConfig(target="planning", exact_bits=(3,))
    for given in (fault, {"target": "planning", "exact_bits": [3]}):
        with pytest.raises(Flown):
            mavfi.fly(short_config, v_max_mps=2, fault=given, out=tmp_path)
    assert flown[0] == flown[1]
    config, out = flown[0]
    assert (config.world, config.v_max_mps, config.fault, out) == ("farm", 2.0, fault, tmp_path)


def test_a_wrong_setting_is_named():
    with pytest.raises(ConfigError, match=r"planer.*planner"):
        mavfi.fly(planer="rrt")
    with pytest.raises(ConfigError, match=r"fault\.bit.*bits"):
        mavfi.fly(fault={"target": "planning", "bit": 3})
    with pytest.raises(ConfigError, match="must be a whole number"):
        mavfi.fly(seed="3")


def test_a_campaign_is_the_table_that_is_exported(flown_campaign, mavfi_command, tmp_path):
    read = mavfi.campaign(flown_campaign)
    assert isinstance(read, library.Campaign)
    assert read.folder == flown_campaign
    assert read.table["outcome"].to_pylist() == ["success"]
    done = mavfi_command("campaign", "export", flown_campaign, tmp_path / "t.parquet")
    assert done.returncode == 0, done.stderr
    assert parquet.read_table(tmp_path / "t.parquet").equals(read.table)


def test_a_campaign_becomes_a_data_frame(flown_campaign):
    frame = mavfi.campaign(flown_campaign).to_pandas()
    assert frame["outcome"].tolist() == ["success"]
    assert frame["label_kind"].tolist() == ["golden"]


def test_without_pandas_one_line_says_what_to_install(flown_campaign, monkeypatch):
    read = mavfi.campaign(flown_campaign)  # pyarrow looks for pandas with its first table only
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MavfiError, match=r"pip install 'mavfi\[pandas\]'"):
        read.to_pandas()


class Images(HTMLParser):
    """The pictures and all other elements of HTML."""

    def __init__(self, text):
        super().__init__()
        self.sources, self.others = [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        if tag == "img":
            self.sources.append(dict(attrs)["src"])
        else:
            self.others.append(tag)


def test_a_notebook_shows_summary_and_picture_of_a_run(short_flight):
    run = mavfi.load_run(short_flight.path)
    assert repr(run) == f"Run('{short_flight.path}', outcome='success')"
    shown = run._repr_html_()
    assert "SUCCESS: reached the goal" in shown
    (source,) = Images(shown).sources
    kind, _, data = source.partition(",")
    assert kind == "data:image/svg+xml;base64"
    assert "farm, seed 5: success" in base64.b64decode(data).decode()


def test_a_notebook_executes_nothing_from_a_foreign_run(short_flight, tmp_path):
    shutil.copytree(short_flight.path, tmp_path / "run")
    (tmp_path / "run" / "flight.svg").write_text("<svg onload='alert(1)'/>")
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    result["reason"] = "</pre><script>alert(1)</script>"
    result["config"]["world"] = "<img src=x onerror=alert(1)>"
    (tmp_path / "run" / "result.json").write_text(json.dumps(result))
    shown = mavfi.load_run(tmp_path / "run")._repr_html_()
    found = Images(shown)
    assert found.others == ["pre"]
    (source,) = found.sources
    picture = base64.b64decode(source.partition(",")[2]).decode()
    assert "alert" not in picture.replace("&lt;img src=x onerror=alert(1)&gt;", "")


def test_a_notebook_shows_a_campaign_as_a_data_frame(flown_campaign, monkeypatch):
    campaign = mavfi.campaign(flown_campaign)
    assert repr(campaign) == f"Campaign('{flown_campaign}', missions=1)"
    assert campaign._repr_html_() == campaign.to_pandas()._repr_html_()
    monkeypatch.setitem(sys.modules, "pandas", None)
    monkeypatch.setattr(library, "find_spec", lambda name: None)
    assert campaign._repr_html_() is None
