"""Tests how much of the paper's Tables III and IV may be noise, from the printed percentages.

    python benchmarks/paper_noise.py [--draws 200000] [--seed 1]

Prints exact tests of the success rates, and intervals of the recovered share. The counts are the
paper's percentages times the number of its missions. Table IV has 100 golden missions and 300
missions of each other kind in each world, and Table III has 100 missions of each kind.
"""

from __future__ import annotations

import argparse

from scipy.stats import fisher_exact

from mavfi_cli.paper.items import printed
from mavfi_cli.stats.paired import recovered_share

GOLDEN, FAULTY = 100, 300  # missions a world
WORLDS = ("factory", "farm", "sparse", "dense")
SETTINGS = (
    "golden",
    "none",
    "gad",
    "aad",
)  # without a fault; with one, without and with a detector


def fisher(first, second):
    """Return the two-sided p-value of Fisher's exact test of two rates.

    A rate is a pair: the number of successes and the number of missions.
    """
    return fisher_exact([[wins, missions - wins] for wins, missions in (first, second)]).pvalue


def share(*keys: object) -> float:
    """Return a success rate that the paper prints, as a share. The keys select the number."""
    percent = printed(*map(str, keys))
    assert isinstance(percent, float)
    return percent / 100.0


def counts(world: str) -> tuple[int, int, int, int]:
    """Return the successes of the golden and the faulty missions in a world of Table IV.

    The faulty missions fly without a detector, with the Gaussian one and with the autoencoder.
    """
    golden, *others = (share("table4", "success_percent", each, world) for each in SETTINGS)
    faulty, gaussian, autoencoder = (round(FAULTY * each) for each in others)
    return round(GOLDEN * golden), faulty, gaussian, autoencoder


def of_bits(bits: int) -> tuple[int, int]:
    """Return the successes and the missions of the row of Table III for a number of bits."""
    return round(100 * share("table3", "success_percent", bits)), 100


def table_iv(draws: int, seed: int) -> None:
    """Print a line for each world of Table IV, and a line for all worlds pooled."""
    print(
        f"{'Table IV':<9} {'golden':<8} {'faults':<10} {'p':<7} {'recovered by GAD':<21} "
        f"{'by AAD':<21} GAD against AAD, p"
    )
    for world in WORLDS:
        golden, faulty, gaussian, autoencoder = counts(world)
        cells = []
        for wins in (gaussian, autoencoder):
            told = recovered_share(
                (golden, GOLDEN), (faulty, FAULTY), (wins, FAULTY), draws=draws, seed=seed
            )
            ends = (100.0 * each for each in (told.value, told.low, told.high))
            cells.append("{:4.0f} % ({:.0f} to {:.0f})".format(*ends))
        print(
            f"{world.capitalize():<9} {golden:>3}/{GOLDEN}  {faulty:>4}/{FAULTY}   "
            f"{fisher((golden, GOLDEN), (faulty, FAULTY)):<7.2g} {cells[0]:<21} {cells[1]:<21} "
            f"{fisher((gaussian, FAULTY), (autoencoder, FAULTY)):.2f}"
        )
    golden, faulty = (sum(counts(world)[kind] for world in WORLDS) for kind in (0, 1))
    missions = len(WORLDS) * GOLDEN, len(WORLDS) * FAULTY
    p = fisher((golden, missions[0]), (faulty, missions[1]))
    print(f"{'pooled':<9} {golden}/{missions[0]}  {faulty}/{missions[1]}  {p:.2g}")


def table_iii() -> None:
    """Print the tests of whether Table III's success rates differ by more than chance."""
    sparse = counts("sparse")[0]
    one, five = of_bits(1), of_bits(5)
    print(f"\nTable III: 1 bit, {one[0]}/100, against")
    for name, other in (
        ("golden", of_bits(0)),
        ("Table IV's golden in Sparse", (sparse, GOLDEN)),
        ("5 bits", five),
    ):
        print(f"  {name + ',':<28} {other[0]:>3}/{other[1]}  p = {fisher(one, other):.2g}")


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=200_000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    table_iv(options.draws, options.seed)
    table_iii()


if __name__ == "__main__":
    main()
