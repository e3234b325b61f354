"""Compute platforms: their files."""

import pytest
from missions import SOUND_PLATFORM

from mavfi_cli.core.errors import ConfigError, MavfiError, UnknownName
from mavfi_cli.core.types import KERNELS
from mavfi_cli.spec.platform import PLATFORMS, load_platform


@pytest.mark.parametrize("name", PLATFORMS.names)
def test_shipped_platforms_have_every_kernel_with_its_source(name):
    platform = load_platform(name)
    assert platform.name == name
    assert platform.cores >= 1
    for kernel in KERNELS:
        assert platform.kernels[kernel].latency_s > 0.0
        assert platform.kernels[kernel].source
    assert {"cores", "power_w", "spread"} <= set(platform.sources)
    if platform.carried:
        assert {"mass_kg", "heatsink_kgpw"} <= set(platform.sources)


def test_x86_is_the_paper_s(platform_of):
    x86 = load_platform("x86").kernels
    assert x86["octomap"].latency_s == 0.289
    assert x86["planner"].latency_s == 0.083
    assert x86["control"].latency_s == 0.00046


def test_a_file_of_one_s_own(platform_of):
    platform = platform_of(SOUND_PLATFORM)
    assert (platform.name, platform.cores, platform.mass_kg) == ("mine", 2, 0.0)
    assert platform.kernels["octomap"].latency_s == 0.02


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("cores = 2", "cores = 0", r"mine\.toml.*cores .*at least 1"),
        ("cores = 2", "cores = 2.5", r"mine\.toml:2: cores: .*whole number"),
        ("cores = 2", "corse = 2", r"mine\.toml:2: corse: .*'cores'"),
        ("cores = 2", "cores = ", r"mine\.toml:2: Invalid value"),
        ("[kernels.planner]", "[kernels.planer]", r"mine\.toml.*kernels\.planer: .*'planner'"),
        ("latency_s = 0.02", "latency_s = -0.02", r"mine\.toml:6: kernels\.octomap: .*at least 0"),
        ("latency_s = 0.02", "latency_s = nan", "finite"),
        ("latency_s = 0.02", 'latency_s = "fast"', r"mine\.toml:7: kernels\.octomap\.latency_s"),
        ("spread = 0.5", "spread = 2.5", "spread .*between 0 and 2"),
        ("cores = 2", "cores = 2\npower_w = -1.0", r"mine\.toml.*power_w: .*at least 0"),
        ("cores = 2", "cores = 2\nmass_kg = -1.0", r"mine\.toml.*mass_kg: .*at least 0"),
        ("cores = 2", "cores = 2\npower_w = 1e9", r"mine\.toml.*power_w: .*at most"),
        ("latency_s = 0.02", "latency_s = 9e9", r"mine\.toml:6: kernels\.octomap: .*at most 3600"),
        ("latency_s = 0.02", "scale = 2.0", r"mine\.toml.*kernels\.octomap: .*base"),
        ("latency_s = 0.02", "", r"mine\.toml.*kernels\.octomap: .*latency_s or scale"),
        ("cores = 2", "cores = 2\nscale = 2.0", r"mine\.toml.*scale needs a base"),
        ("cores = 2", 'cores = 2\nbase = "x68"', r"mine\.toml: base: .*'x86'"),
    ],
)
def test_what_is_wrong_with_a_file(platform_of, old, new, said):
    with pytest.raises(ConfigError, match=said) as error:
        platform_of(SOUND_PLATFORM.replace(old, new, 1))
    assert "\n" not in str(error.value)


def test_a_kernel_too_many(platform_of):
    with pytest.raises(ConfigError, match=r"kernels\.dreams: .* point_cloud"):
        platform_of(SOUND_PLATFORM + "[kernels.dreams]\nlatency_s = 1.0\n")


def test_a_kernel_missing(platform_of):
    text = SOUND_PLATFORM[: SOUND_PLATFORM.index("[kernels.control]")]
    with pytest.raises(ConfigError, match=r"mine\.toml: kernels\.control: missing"):
        platform_of(text)


SCALED = """name = "mine"
base = "x86"
cores = 4
scale = 3.0
[kernels.octomap]
scale = 2.0
source = "a guess"
[kernels.planner]
latency_s = 0.5
[kernels.control]
scale = 1.5
spread = 0.0
"""


def test_a_platform_that_scales_another(platform_of):
    mine, x86 = platform_of(SCALED).kernels, load_platform("x86").kernels
    factors = {kernel: mine[kernel].latency_s / x86[kernel].latency_s for kernel in KERNELS}
    assert factors == pytest.approx(
        {"point_cloud": 3.0, "octomap": 2.0, "collision_check": 3.0,
         "planner": 0.5 / 0.083, "control": 1.5}
    )  # fmt: skip
    assert mine["octomap"].spread == x86["octomap"].spread
    assert mine["control"].spread == 0.0
    assert mine["octomap"].source == "x86 x 2: a guess"
    assert mine["point_cloud"].source == "x86 x 3"
    assert load_platform("x86").mass_kg == platform_of(SCALED).mass_kg == 0.0


def test_a_scale_must_be_above_zero(platform_of):
    with pytest.raises(ConfigError, match=r"mine\.toml.*kernels\.octomap: scale .*above 0"):
        platform_of(SCALED.replace("scale = 2.0", "scale = -2.0"))


def test_a_scale_that_goes_too_far(platform_of):
    with pytest.raises(ConfigError, match=r"mine\.toml: latency_s .*at most 3600"):
        platform_of(SCALED.replace("scale = 3.0", "scale = 1e9"))


def test_tx2_is_slower_in_every_kernel_and_with_every_cut():
    x86, tx2 = load_platform("x86").kernels, load_platform("tx2").kernels
    assert all(tx2[kernel].latency_s > x86[kernel].latency_s for kernel in KERNELS)
    octomap = [
        load_platform(name).kernels["octomap"].latency_s
        for name in ("tx2", "tx2-2c-2.04", "tx2-4c-0.81", "tx2-2c-0.81")
    ]
    assert octomap == sorted(octomap)
    # MAVBench logs of the mapping application, medians over that of four cores at 2.04 GHz
    logged = [0.458, 0.667, 1.20, 2.96]
    for found, seconds in zip(octomap, logged, strict=True):
        assert found / octomap[0] == pytest.approx(seconds / logged[0], rel=0.01)


@pytest.mark.parametrize(
    ("name", "kind"), [("x87", UnknownName), ("none.toml", ConfigError), ("", UnknownName)]
)
def test_no_such_platform(name, kind):
    with pytest.raises(kind):
        load_platform(name)
    assert issubclass(kind, MavfiError)
