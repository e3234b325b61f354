"""Whole flights that several test modules read: flown once a test process."""

from __future__ import annotations

import contextlib
import gc
import os
import select
import socket
import subprocess
import sys
import tempfile
import threading
from collections import Counter
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from hypothesis import settings
from missions import POSTS, SHORT

from mavfi_cli import cli
from mavfi_cli.autonomy.warm import warm_up
from mavfi_cli.core.fork_server import ForkServer
from mavfi_cli.link.codec import Codec
from mavfi_cli.mission.progress import Watcher
from mavfi_cli.mission.run import fly_mission
from mavfi_cli.mission.vehicle import Vehicle
from mavfi_cli.spec.detector import DetectorConfig
from mavfi_cli.spec.mission import MissionConfig
from mavfi_cli.spec.platform import load_platform
from sitl.camera.component import COMPONENT_ID, Camera

sys.path.insert(0, str(Path(__file__).parent / "link"))  # scripted autopilots
settings.register_profile("no clock", deadline=None)  # no test asserts speed by the clock
settings.load_profile("no clock")
_SLOW_TO_LOAD = ("mavfi_cli.campaigns.task", "fake_task")  # modules of fork servers
_OF_TEST = ("PYTEST_CURRENT_TEST", "COLUMNS")  # variables that differ without effect on a campaign
TICK_WALL_S = 0.01  # of a scripted autopilot that gets no answer


def pytest_configure(config):
    """Compile every kernel once, before workers would all do so at once."""
    if getattr(config.option, "numprocesses", None):
        warm_up()


def pytest_collection_modifyitems(items):
    """Begin with the files that have slow tests, so that no long test is left for the end."""
    slow = Counter(item.path for item in items if item.get_closest_marker("slow"))
    items.sort(key=lambda item: -slow[item.path])


def pytest_collection_finish():
    """Keep the garbage collector from visiting the thousands of tests again and again."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def _kept_servers():
    """Keep a server whose campaign has ended for the next campaign, because it loads for seconds.

    Another environment gets a server of its own. Tests that look for the processes of a campaign
    mark its environment; a server with the mark ends with its campaign.
    """
    kept, running, close = {}, ForkServer._running, ForkServer.close

    def key(server):
        environment = {name: text for name, text in os.environ.items() if name not in _OF_TEST}
        return server._module, *sorted(environment.items())

    def take(server):
        if server._control is None:
            server._key = key(server)
            server._control, server._process = kept.pop(server._key, (None, None))
        return running(server)

    def keep(server):
        parts, serving = (server._control, server._process), server._process is not None
        if not serving or server._process.poll() is not None or server._key in kept:
            return close(server)
        if "MAVFI_TEST_CAMPAIGN" not in os.environ and server._module in _SLOW_TO_LOAD:
            kept[server._key] = parts
            server._control = server._process = None
        return close(server)

    with mock.patch.multiple(ForkServer, _running=take, close=keep):
        yield
    for control, process in kept.values():
        control.close()
        process.wait()


@pytest.fixture(scope="session")
def short_config():
    """The short mission."""
    return SHORT


@pytest.fixture(scope="session")
def fly_short(tmp_path_factory):
    """Fly the short mission with changes, in this process; its run folder."""
    out = tmp_path_factory.mktemp("runs")

    def fly(watcher=None, *, launch=Vehicle.start, **changes):
        if "link" in changes and not changes.get("eyes"):  # a flight without a world
            changes = {"world": MissionConfig().world, "start": None, **changes}
        return fly_mission(replace(SHORT, **changes), out, watcher or Watcher(), launch=launch)

    return fly


@pytest.fixture(scope="session")
def short_flight(fly_short):
    """Run folder of one successful flight; do not change it."""
    return fly_short()


@pytest.fixture(scope="session")
def watched_flight(fly_short):
    """Run folder of the same flight with a detector that also watches numbers of plans."""
    return fly_short(detector=DetectorConfig(name="gad", watch="extended"))


@pytest.fixture(scope="session")
def troubled_flight(tmp_path_factory):
    """Run folder of a flight that had to replan: boxes stand in the straight way."""
    folder = tmp_path_factory.mktemp("troubled")
    world = folder / "posts.toml"
    world.write_text(POSTS)
    return fly_mission(
        MissionConfig(world=str(world), seed=2, stack="hardened"), folder / "runs", Watcher()
    )


@contextlib.contextmanager
def _collected(descriptor, redirect):
    """Collect what this process and its children write to a standard stream, as one text."""
    kept, texts = os.dup(descriptor), []
    with tempfile.TemporaryFile("w+", encoding="utf-8") as file:
        try:
            os.dup2(file.fileno(), descriptor)
            with redirect(file):
                yield texts
        finally:
            os.dup2(kept, descriptor)
            os.close(kept)
            file.seek(0)
            texts.append(file.read())


def _become(_path, line):
    """Run the program as a child: the test's own process must stay."""
    sys.exit(subprocess.call(line))


@pytest.fixture(scope="session")
def mavfi():
    """Run the command line in this process; exit code, stdout and stderr as of a process."""

    def run(*arguments, cwd="."):
        line = ["mavfi", *map(str, arguments)]
        with (
            contextlib.chdir(cwd),
            mock.patch.multiple(sys, argv=line),
            mock.patch("os.execv", _become),
            mock.patch("mavfi_cli.cli.leave", sys.exit),
            _collected(1, contextlib.redirect_stdout) as out,
            _collected(2, contextlib.redirect_stderr) as err,
        ):
            try:
                cli.main()
            except SystemExit as left:
                code = left.code
        return subprocess.CompletedProcess(line, code, *out, *err)

    return run


@pytest.fixture
def free_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def start_sitl(free_port):
    """Start a stand-alone simulated vehicle that sends to a port; the URL to hear it."""
    line = [
        sys.executable, "-m", "sitl", "--world", "farm", "--seed", "5", "--start=2,2,0",
        "--goal=10,6,5", "--link", f"onboard=udpout:127.0.0.1:{free_port}", "--speed", "2",
    ]  # fmt: skip

    @contextlib.contextmanager
    def started():
        with contextlib.ExitStack() as stack:
            process = subprocess.Popen(line, stderr=subprocess.DEVNULL)
            stack.callback(process.wait)
            stack.callback(process.kill)
            yield f"udpin:127.0.0.1:{free_port}"

    return started


class AutopilotOnUdp:
    """A scripted autopilot that calls a UDP port: as fast as it gets answers, at least double.

    A depth camera in an empty world flies with it.

    Attributes:
        muted: kinds of messages that it no longer sends.
        extra: messages that it sends at every tick besides.
        noise: makes bytes to send at every tick, or None.
        pause_s: wall time that every tick takes besides.
    """

    def __init__(self, autopilot, port, *, camera=True):
        self.autopilot = autopilot
        self.camera = Camera(np.zeros((0, 6))) if camera else None
        self.muted = set()
        self.extra = []
        self.noise = None
        self.pause_s = 0.0
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(("127.0.0.1", port))
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self):
        decoder, encoder, of_camera = Codec(255, 255), Codec(1, 1), Codec(1, COMPONENT_ID)
        while not self._over.is_set():
            inbox = []
            wait_s = TICK_WALL_S
            while select.select([self._socket], [], [], wait_s)[0]:
                try:
                    inbox += decoder.decode(self._socket.recv(65536))
                    wait_s = 0.0
                except ConnectionError:  # nobody listens yet
                    self._over.wait(TICK_WALL_S)
                    break
            self._over.wait(self.pause_s)
            messages = [*self.autopilot.advance(inbox), *self.extra]
            frames = [encoder.encode(m) for m in messages if m.get_type() not in self.muted]
            if self.camera is not None:
                frames += [of_camera.encode(m) for m in self._photograph(inbox)]
            for frame in [self.noise(), *frames] if self.noise else frames:
                with contextlib.suppress(ConnectionError):
                    self._socket.send(frame)

    def _photograph(self, inbox):
        """What the camera sends at this tick, seen level and eastwards."""
        answers = [answer for message in inbox for answer in self.camera.handle(message)]
        pose = np.array(self.autopilot.position_enu_m), np.array([1.0, 0.0, 0.0, 0.0])
        return answers + self.camera.poll(self.autopilot.stamp_s, *pose)

    def close(self):
        self._over.set()
        self._thread.join()
        self._socket.close()


@pytest.fixture
def autopilot_on_udp(free_port):
    """Starts a scripted autopilot on UDP; it and the URL under which a mission hears it."""
    with contextlib.ExitStack() as stack:

        def start(autopilot, **options):
            link = AutopilotOnUdp(autopilot, free_port, **options)
            stack.callback(link.close)
            return link, f"udpin:127.0.0.1:{free_port}"

        yield start


@pytest.fixture
def platform_of(tmp_path):
    """Load a platform from the text of its file."""

    def load(text):
        path = tmp_path / "mine.toml"
        path.write_text(text)
        return load_platform(str(path))

    return load
