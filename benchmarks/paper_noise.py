"""How much of the paper's Tables III and IV is noise: exact tests, and intervals of "recovered".

    python benchmarks/paper_noise.py [--draws 200000] [--seed 1]

The counts are the paper's percentages times the number of its missions. Table IV has 100 golden
missions and 300 of each other kind in each world, Table III has 100 of each kind.
"""

from __future__ import annotations

import argparse

from mavfi_cli.stats.effects import fisher, recovered_share

GOLDEN, FAULTY = 100, 300  # missions a world
TABLE_IV = {  # world: successes golden, with faults, with the Gaussian, with the autoencoder, %
    "Factory": (100.0, 91.7, 98.7, 99.3),
    "Farm": (100.0, 97.3, 99.3, 100.0),
    "Sparse": (95.0, 88.3, 94.3, 95.0),
    "Dense": (85.0, 75.3, 83.0, 84.7),
}
TABLE_III = {0: 100, 1: 92, 3: 91, 5: 89}  # bits: successes of 100


def counts(world: str) -> tuple[int, int, int, int]:
    """Successes of golden, faulty, Gaussian and autoencoder missions."""
    golden, faulty, gaussian, autoencoder = TABLE_IV[world]
    wins = [round(FAULTY * rate / 100.0) for rate in (faulty, gaussian, autoencoder)]
    return round(GOLDEN * golden / 100.0), wins[0], wins[1], wins[2]


def table_iv(draws: int, seed: int) -> None:
    """Print a line a world, and the pooled one."""
    print(
        f"{'Table IV':<9} {'golden':<8} {'faults':<10} {'p':<7} {'recovered by GAD':<21} "
        f"{'by AAD':<21} GAD against AAD, p"
    )
    for world in TABLE_IV:
        golden, faulty, gaussian, autoencoder = counts(world)
        cells = []
        for wins in (gaussian, autoencoder):
            told = recovered_share(
                (golden, GOLDEN), (faulty, FAULTY), (wins, FAULTY), draws=draws, seed=seed
            )
            ends = (100.0 * each for each in (told.value, told.low, told.high))
            cells.append("{:4.0f} % ({:.0f} to {:.0f})".format(*ends))
        print(
            f"{world:<9} {golden:>3}/{GOLDEN}  {faulty:>4}/{FAULTY}   "
            f"{fisher((golden, GOLDEN), (faulty, FAULTY)):<7.2g} {cells[0]:<21} {cells[1]:<21} "
            f"{fisher((gaussian, FAULTY), (autoencoder, FAULTY)):.2f}"
        )
    golden, faulty = (sum(counts(world)[kind] for world in TABLE_IV) for kind in (0, 1))
    missions = len(TABLE_IV) * GOLDEN, len(TABLE_IV) * FAULTY
    p = fisher((golden, missions[0]), (faulty, missions[1]))
    print(f"{'pooled':<9} {golden}/{missions[0]}  {faulty}/{missions[1]}  {p:.2g}")


def table_iii() -> None:
    """Print what its success rates differ by, beyond chance."""
    sparse = counts("Sparse")[0]
    one, five = (TABLE_III[1], 100), (TABLE_III[5], 100)
    print(f"\nTable III: 1 bit, {one[0]}/100, against")
    for name, other in (
        ("golden", (TABLE_III[0], 100)),
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
