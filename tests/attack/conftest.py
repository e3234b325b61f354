"""Native programs; inputs of the kernels, recorded once, and a campaign on them."""

import shutil
from pathlib import Path

import pytest
from missions import POSTS
from native_programs import native_program, start, tracing_problem  # noqa: F401

from mavfi_cli.attack.campaign import Plan, run_campaign
from mavfi_cli.attack.kernels.inputs import load_inputs, save_inputs
from mavfi_cli.attack.kernels.target import KernelTarget
from mavfi_cli.mission.kernel_inputs import record_inputs
from mavfi_cli.spec.mission import MissionConfig


@pytest.fixture(scope="session")
def tracing():
    """Skips where nothing can be traced."""
    problem = tracing_problem()
    if problem:
        pytest.skip(problem)


@pytest.fixture(scope="session")
def kernel_inputs(tmp_path_factory) -> Path:
    """A file of kernel inputs, from a flight round a row of boxes."""
    folder = tmp_path_factory.mktemp("inputs")
    world = folder / "posts.toml"
    world.write_text(POSTS)
    path = folder / "inputs.npz"
    save_inputs(path, record_inputs(MissionConfig(world=str(world), seed=2, stack="hardened")))
    return path


@pytest.fixture(scope="session")
def two_inputs(tmp_path_factory, kernel_inputs) -> Path:
    """A file of two of the kernel inputs: it takes seconds to profile a long kernel on an input."""
    path = tmp_path_factory.mktemp("two") / "inputs.npz"
    save_inputs(path, load_inputs(kernel_inputs)[0][2:4])
    return path


@pytest.fixture(scope="session")
def attack(tracing, kernel_inputs):
    """Function that runs a campaign on those inputs, or on those of another file."""

    def run(*kernels, runs=10, jobs=1, folder=None, seed=5, tolerance=0.0, inputs=kernel_inputs,
            **changes):  # fmt: skip
        plan = Plan(runs=runs, seed=seed, **changes)
        (first, *_), sha256 = load_inputs(inputs)
        targets = [
            KernelTarget(
                kernel=kernel, inputs=inputs, inputs_sha256=sha256, flight=first.flight,
                tolerance=tolerance,
            )
            for kernel in kernels
        ]  # fmt: skip
        return plan, run_campaign(plan, targets, jobs=jobs, folder=folder)

    return run


@pytest.fixture(scope="session")
def control_folder(tmp_path_factory, kernel_inputs):
    """The folder of the campaign on the controller; copy it before you change it."""
    folder = tmp_path_factory.mktemp("control")
    (folder / "inputs.npz").write_bytes(kernel_inputs.read_bytes())
    return folder


@pytest.fixture(scope="session")
def control_campaign(attack, control_folder):
    """Thirty faults in the controller."""
    return attack("control", runs=30, folder=control_folder)


@pytest.fixture
def control_copy(control_campaign, control_folder, tmp_path):
    """A copy of that campaign's folder."""
    return Path(shutil.copytree(control_folder, tmp_path / "control"))
