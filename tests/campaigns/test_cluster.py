"""A real scheduler and two worker processes on loopback: the results of the local run."""

import json
import os
import re
import signal
import socket
import ssl
import subprocess
import sys
from pathlib import Path

import pytest
from killing import results_of
from missions import SHORT_WAY
from plans import planned

from mavfi_cli.campaigns.cluster_keys import CERTIFICATE, KEY, make_keys, security
from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.campaigns.specification import Keep
from mavfi_cli.campaigns.workers import CampaignStopped, Cluster
from mavfi_cli.core.errors import ConfigError

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

folder, address, keys, *worlds = sys.argv[1:]
keys = Path(keys) if keys else None
options = Options(keep=Keep.ALL, task="fake_task", cluster=address, cluster_key=keys)
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
    """A scheduler and workers in processes of their own, as docs/how-to/cluster.md starts them."""

    def __init__(self, folder, keys=None):
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        self.address = f"{'tls' if keys else 'tcp'}://127.0.0.1:{port}"
        self.keys, self._folder = keys, folder
        self._processes = []
        scheduler = self._start(
            ["-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", str(port),
             "--no-dashboard", "--no-jupyter", *self._tls()], subprocess.PIPE,
        )  # fmt: skip
        assert any(b"Scheduler at:" in line for line in scheduler.stderr), "it did not start"

    def worker(self, program=("-m", "distributed.cli.dask_worker")):
        """One more worker: one process, one thread, nobody to start it again."""
        return self._start(
            [*program, self.address, "--host", "127.0.0.1", "--nthreads", "1", "--no-nanny",
             "--no-dashboard", "--dashboard-address", "127.0.0.1:0",
             "--local-directory", str(self._folder), *self._tls()]
        )  # fmt: skip

    def _tls(self):
        files = {"ca-file": CERTIFICATE, "cert": CERTIFICATE, "key": KEY} if self.keys else {}
        return [
            word for name, file in files.items() for word in (f"--tls-{name}", self.keys / file)
        ]

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


@pytest.fixture
def locked_cluster(tmp_path):
    (tmp_path / "cluster").mkdir()
    make_keys(tmp_path / "keys")
    started = LocalCluster(tmp_path / "cluster", tmp_path / "keys")
    yield started
    started.close()


def start(folder, cluster, *worlds):
    """The runner in a process of its own: dask is not for a process that forks."""
    where = (str(folder), cluster.address, str(cluster.keys or ""))
    line = [sys.executable, "-c", RUNNER, *where, *worlds]
    return subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def run_folders(folder):
    with Ledger(folder) as ledger:
        paths = [result.path for result in ledger.results() if result.path is not None]
    return {path.name: {file.name: file.read_bytes() for file in path.iterdir()} for path in paths}


@pytest.mark.slow
def test_a_cluster_that_loses_a_worker_has_the_results_of_the_local_run(
    campaign, cluster, tmp_path
):
    worlds = [*["sleep:0.5"] * 8, "end:collision", "exit:3", f"signal:{int(signal.SIGSEGV)}"]
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
def test_a_worker_of_another_version_is_named_and_refused(cluster, tmp_path):
    cluster.worker(("-c", OTHER_BUILD))
    runner = start(tmp_path / "remote", cluster, "fly")
    _, err = runner.communicate(timeout=START_S)
    assert runner.returncode == 1
    last = err.strip().splitlines()[-1]
    assert "worker tcp://127.0.0.1:" in last
    assert "mavfi was 0.2.0, is 0.0.1" in last


@pytest.mark.slow
def test_only_the_key_opens_a_cluster_with_keys(locked_cluster, tmp_path):
    from distributed import Client

    locked_cluster.worker()
    runner = start(tmp_path / "remote", locked_cluster, "fly")
    _, err = runner.communicate(timeout=START_S)
    assert runner.returncode == 0, err
    assert len(results_of(tmp_path / "remote")) == 1
    make_keys(tmp_path / "others")
    with pytest.raises(CampaignStopped, match=r"scheduler at tls://.* with the keys in .*others"):
        Cluster(locked_cluster.address, Keep.NONE, keys=tmp_path / "others")
    plain = locked_cluster.address.replace("tls:", "tcp:")
    with pytest.raises(CampaignStopped, match="cannot connect to a scheduler at tcp://"):
        Cluster(plain, Keep.NONE)
    with pytest.raises((OSError, TypeError)):  # what any program of another user could do
        Client(locked_cluster.address, timeout=5.0, set_as_default=False)


def shaken(client, server):
    """Shake hands in memory; whether both sides accept."""
    inbox, outbox = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = [
        client.wrap_bio(inbox, outbox),
        server.wrap_bio(outbox, inbox, server_side=True),
    ]
    for _ in range(5):
        for end in ends:
            try:
                end.do_handshake()
            except ssl.SSLWantReadError:
                continue
            except ssl.SSLError:
                return False
    return all(end.version() for end in ends)


def test_a_certificate_opens_for_its_own_key_only(tmp_path):
    contexts = []
    for name in ("ours", "others"):
        make_keys(tmp_path / name)
        keys = security(tmp_path / name)
        contexts.append(
            (keys.get_connection_args("client")["ssl_context"],
             keys.get_listen_args("scheduler")["ssl_context"])
        )  # fmt: skip
    (client, scheduler), (other_client, other_scheduler) = contexts
    nobody = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    nobody.check_hostname, nobody.verify_mode = False, ssl.CERT_NONE
    assert shaken(client, scheduler)
    assert not shaken(other_client, scheduler)
    assert not shaken(client, other_scheduler)
    assert not shaken(nobody, scheduler)


def test_keys_are_private_and_never_replaced(mavfi, tmp_path):
    first = mavfi("campaign", "keys", "keys", cwd=tmp_path)
    assert (first.returncode, first.stderr) == (0, "")
    assert "keys/cert.pem and keys/key.pem" in first.stdout
    paths = [tmp_path / "keys" / name for name in (CERTIFICATE, KEY)]
    assert [path.stat().st_mode & 0o777 for path in (tmp_path / "keys", *paths)] == [
        0o700, 0o600, 0o600,
    ]  # fmt: skip
    written = [path.read_bytes() for path in paths]
    again = mavfi("campaign", "keys", "keys", cwd=tmp_path)
    assert again.returncode == 1
    assert again.stderr.startswith("error: keys/key.pem: already exists")
    assert [path.read_bytes() for path in paths] == written


def test_keys_are_not_written_through_a_link(tmp_path):
    (tmp_path / "keys").mkdir()
    (tmp_path / "keys" / KEY).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ConfigError, match="exists"):
        make_keys(tmp_path / "keys")
    assert not (tmp_path / "elsewhere").exists()


@pytest.mark.parametrize("name", [CERTIFICATE, KEY])
def test_keys_that_others_can_read_or_that_are_missing_are_refused(name, tmp_path):
    make_keys(tmp_path)
    (tmp_path / name).chmod(0o640)
    with pytest.raises(ConfigError, match="nobody else can access"):
        security(tmp_path)
    (tmp_path / name).unlink()
    with pytest.raises(ConfigError, match=rf"{name}: .*mavfi campaign keys"):
        security(tmp_path)


@pytest.mark.parametrize(
    "options",
    [
        ("--cluster", "tls://127.0.0.1:1"),
        ("--cluster", "tcp://127.0.0.1:1", "--cluster-key", "keys"),
        ("--cluster-key", "keys"),
    ],
)
def test_an_address_and_its_keys_go_together(mavfi, options, tmp_path):
    run = mavfi("campaign", "run", "fig8", *options, cwd=tmp_path)
    assert run.returncode == 2
    assert re.match("error: --cluster: .*tls:// .* --cluster-key", run.stderr)
    assert list(tmp_path.iterdir()) == []


def test_a_scheduler_that_is_not_there_gets_one_line(mavfi, tmp_path, free_port, monkeypatch):
    monkeypatch.setattr("mavfi_cli.campaigns.workers.CONNECT_S", 0.5)
    spec = tmp_path / "one.toml"
    spec.write_text("[factors]\nworld = 'farm'\n")
    address = f"tcp://127.0.0.1:{free_port}"
    run = mavfi("campaign", "run", spec, "--cluster", address, "--quiet", cwd=tmp_path)
    assert (run.returncode, run.stdout) == (1, "")
    warning, line = run.stderr.splitlines()
    assert warning.startswith(f"warning: {address} has no TLS")
    assert line.startswith(f"error: cannot connect to a scheduler at {address}: ")


@pytest.mark.parametrize(
    "address", ["nonsense", "127.0.0.1:8786", "tcp://127.0.0.1", "tcp://127.0.0.1:port", ""]
)
def test_what_is_no_address_is_wrong_usage(address, mavfi):
    run = mavfi("campaign", "run", "table4", "--cluster", address, "--quiet")
    assert (run.returncode, run.stdout) == (2, "")
    assert run.stderr.startswith("error: --cluster: ")
    assert run.stderr.endswith(f"tls://host:8786, got {address!r}\n")


@pytest.mark.slow
def test_real_flights_are_the_same_on_a_cluster_whose_worker_leaves_no_folder_behind(
    cluster, mavfi, monkeypatch, tmp_path
):
    spec = tmp_path / "short.toml"
    spec.write_text(
        f"{SHORT_WAY}[factors]\nworld = 'farm'\n[[setting]]\n[[setting]]\nstage = 'control'\n"
    )
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    with monkeypatch.context() as patch:
        patch.setenv("TMPDIR", str(scratch))
        worker = cluster.worker()
    for out, options in (("local", ()), ("far", ("--cluster", cluster.address))):
        run = mavfi("campaign", "run", spec, "--out", tmp_path / out, "--keep", "all", *options)
        assert run.returncode == 0, run.stderr
    assert results_of(tmp_path / "far") == results_of(tmp_path / "local")
    assert list(scratch.glob("mavfi-worker-*"))
    worker.terminate()
    worker.wait(START_S)
    assert not list(scratch.glob("mavfi-worker-*"))
    local, far = (run_folders(Path(tmp_path / out)) for out in ("local", "far"))
    for folder in (local, far):
        for files in folder.values():
            result = json.loads(files["result.json"])
            files["result.json"] = {k: v for k, v in result.items() if k != "host"}
    assert far == local


@pytest.mark.slow
def test_a_users_companion_flies_on_a_worker(cluster, mavfi, tmp_path):
    (tmp_path / "looks.toml").write_text("[program.looks]\ncommand = 'echo {start}'\n")
    spec = tmp_path / "looking.toml"
    companion = tmp_path / "looks.toml"  # an absolute path: the worker runs in another folder
    spec.write_text(f"[mission]\ncompanion = '{companion}'\nworld = 'farm'\n[[setting]]\n")
    cluster.worker()
    options = ("--keep", "all", "--cluster", cluster.address)
    run = mavfi("campaign", "run", spec, "--out", tmp_path / "far", *options)
    assert run.returncode == 0, run.stderr
    [said] = (tmp_path / "far" / "runs").glob("*/programs/looks/stdout")
    assert said.read_text().count(",") == 2
