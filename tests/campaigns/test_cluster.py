"""A real scheduler and two worker processes on loopback: the results of the local run."""

import json
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from killing import results_of
from missions import SHORT_WAY
from plans import planned

from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.campaigns.specification import Keep
from mavfi_cli.campaigns.workers import CampaignStopped, Cluster

pytest.importorskip("distributed", reason="the extra cluster is not installed")
START_S = 90.0
RUNNER = """
import sys
from pathlib import Path
from plans import planned
from mavfi_cli.campaigns.specification import Keep
from mavfi_cli.campaigns.progress import Spectator
from mavfi_cli.campaigns.run import Options, run_campaign

class Telling(Spectator):
    def on_progress(self, progress):
        print(progress.over, flush=True)

folder, address, *worlds = sys.argv[1:]
options = Options(keep=Keep.ALL, task="fake_task", cluster=address)
run_campaign(planned(*worlds), Path(folder), options, Telling()).close()
"""
# A worker of another build: what it says of its versions is changed before it serves.
OTHER_BUILD = """
import sys
import mavfi_cli.core.installed as versions
versions.__dict__["__version__"] = "0.0.1"
from distributed.cli.dask_worker import main
sys.argv = ["dask-worker", *sys.argv[1:]]
main()
"""


class LocalCluster:
    """A scheduler and workers in processes of their own."""

    def __init__(self, folder):
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{port}"
        self._folder = folder
        self._processes = []
        scheduler = self._start(
            ["-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", str(port),
             "--no-dashboard", "--no-jupyter"], subprocess.PIPE,
        )  # fmt: skip
        assert any(b"Scheduler at:" in line for line in scheduler.stderr), "it did not start"

    def worker(self, program=("-m", "distributed.cli.dask_worker")):
        """One more worker: one process, one thread, nobody to start it again."""
        return self._start(
            [*program, self.address, "--host", "127.0.0.1", "--nthreads", "1", "--no-nanny",
             "--no-dashboard", "--local-directory", str(self._folder)]
        )  # fmt: skip

    def _start(self, arguments, stderr=None):
        log = (self._folder / f"{len(self._processes)}.log").open("wb")
        with log:
            process = subprocess.Popen(
                [sys.executable, *arguments], stdout=log, stderr=stderr or log, cwd=self._folder
            )
        self._processes.append(process)
        return process

    def close(self):
        for process in reversed(self._processes):
            process.kill()
            process.communicate()


@pytest.fixture
def cluster(tmp_path):
    (tmp_path / "cluster").mkdir()
    started = LocalCluster(tmp_path / "cluster")
    yield started
    started.close()


def start(folder, cluster, *worlds):
    """The runner in a process of its own: dask is not for a process that forks."""
    line = [sys.executable, "-c", RUNNER, str(folder), cluster.address, *worlds]
    return subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def run_folders(folder):
    with Ledger(folder) as ledger:
        paths = [result.path for result in ledger.results() if result.path is not None]
    return {path.name: {file.name: file.read_bytes() for file in path.iterdir()} for path in paths}


@pytest.mark.slow
def test_a_cluster_that_loses_a_worker_has_the_results_of_the_local_run(
    campaign, cluster, tmp_path
):
    worlds = [*["sleep:0.5"] * 16, "end:collision", "exit:3", f"signal:{int(signal.SIGSEGV)}"]
    campaign.run(planned(*worlds), keep=Keep.ALL).close()
    workers = [cluster.worker(), cluster.worker()]
    remote = tmp_path / "remote"
    runner = start(remote, cluster, *worlds)
    over = next((number for number in map(int, runner.stdout) if number), None)
    assert over is not None, runner.stderr.read()
    assert over < len(worlds)
    os.kill(workers[0].pid, signal.SIGKILL)
    _, err = runner.communicate(timeout=START_S)
    assert runner.returncode == 0, err
    assert results_of(remote) == results_of(campaign.folder)
    assert [number for number, *_ in results_of(remote)] == list(range(len(worlds)))
    local, far = run_folders(campaign.folder), run_folders(remote)
    for folder in (local, far):
        for files in folder.values():
            files.pop("stderr.txt", None)  # addresses in the traceback of a segmentation fault
    assert far == local


@pytest.mark.slow
def test_a_worker_that_ends_leaves_no_folder_behind(cluster, monkeypatch, tmp_path):
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setenv("TMPDIR", str(scratch))
    worker = cluster.worker()
    runner = start(tmp_path / "remote", cluster, "fly")
    _, err = runner.communicate(timeout=START_S)
    assert runner.returncode == 0, err
    assert list(scratch.glob("mavfi-worker-*"))
    worker.terminate()
    worker.wait(START_S)
    assert not list(scratch.glob("mavfi-worker-*"))


@pytest.mark.slow
def test_a_worker_of_another_version_is_named_and_refused(cluster, tmp_path):
    cluster.worker(("-c", OTHER_BUILD))
    runner = start(tmp_path / "remote", cluster, "fly")
    _, err = runner.communicate(timeout=START_S)
    assert runner.returncode == 1
    last = err.strip().splitlines()[-1]
    assert "worker tcp://127.0.0.1:" in last
    assert "has other versions: mavfi was 0.2.0, is 0.0.1" in last


def test_a_scheduler_that_is_not_there_gets_one_line(mavfi, tmp_path, free_port):
    spec = tmp_path / "one.toml"
    spec.write_text("[factors]\nworld = 'farm'\n")
    address = f"tcp://127.0.0.1:{free_port}"
    run = mavfi("campaign", "run", spec, "--cluster", address, "--quiet", cwd=tmp_path)
    assert (run.returncode, run.stdout) == (1, "")
    (line,) = run.stderr.splitlines()
    assert line.startswith(f"error: no scheduler at {address}: ")


@pytest.mark.parametrize(
    "address", ["nonsense", "127.0.0.1:8786", "tcp://127.0.0.1", "tcp://127.0.0.1:port"]
)
def test_what_is_no_address_is_refused_at_once(address):
    with pytest.raises(CampaignStopped, match="expected the scheduler's address, such as tcp://"):
        Cluster(address, Keep.NONE)


@pytest.mark.slow
def test_real_flights_are_the_same_on_a_cluster(cluster, mavfi, tmp_path):
    spec = tmp_path / "short.toml"
    spec.write_text(
        f"{SHORT_WAY}[factors]\nworld = 'farm'\n[[setting]]\n[[setting]]\nstage = 'control'\n"
    )
    cluster.worker()
    for out, options in (("local", ()), ("far", ("--cluster", cluster.address))):
        run = mavfi("campaign", "run", spec, "--out", tmp_path / out, "--keep", "all", *options)
        assert run.returncode == 0, run.stderr
    assert results_of(tmp_path / "far") == results_of(tmp_path / "local")
    local, far = (run_folders(Path(tmp_path / out)) for out in ("local", "far"))
    for folder in (local, far):
        for files in folder.values():
            result = json.loads(files["result.json"])
            files["result.json"] = {k: v for k, v in result.items() if k != "host"}
    assert far == local
