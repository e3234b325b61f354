"""Flies the missions of a campaign that have no result yet, and applies the stopping rule, if any.

The stopping rule checks the confidence interval of a setting's success rate after every batch. It
uses exactly the setting's missions up to that point in the list, regardless of the order in which
they ended, so the number of workers does not affect when a setting stops. Repeated checks make the
true confidence slightly lower than the nominal one.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import shutil
import time
from collections import Counter, OrderedDict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from urllib.parse import urlsplit

from mavfi_cli.campaigns.ledger import RUNS, Drawn, Ledger
from mavfi_cli.campaigns.missions import (
    COUNTED,
    Injected,
    MissingMission,
    PlannedMission,
    ResultState,
    canonical,
    changes_of,
)
from mavfi_cli.campaigns.progress import Progress, Spectator
from mavfi_cli.campaigns.specification import Keep, Stop
from mavfi_cli.campaigns.strata import Rounds
from mavfi_cli.campaigns.workers import (
    TASK,
    Attempt,
    AttemptEnd,
    AttemptResult,
    CampaignStopped,
    Cluster,
    LocalWorkers,
)
from mavfi_cli.core.errors import ConfigError, Interrupted
from mavfi_cli.core.files import file_digest, own_folder, sync_folder, writing
from mavfi_cli.core.installed import installed_versions, version_differences
from mavfi_cli.core.processes import fork, interruptible, leave_network
from mavfi_cli.mission.instruction import CACHE, kept_in
from mavfi_cli.mission.measures import FlightRecord
from mavfi_cli.mission.run_folder import RESULT
from mavfi_cli.spec.companion import CompanionConfig
from mavfi_cli.spec.mission import MissionConfig
from mavfi_cli.stats.strata import weighted_share

Row = tuple[str | None, str | None]  # outcome, fate of the fault


WORK, PROFILES = "work", "profiles"
ATTEMPTS = 3  # most attempts at a mission if something outside it ends them
LIMIT_S = 900.0  # wall time of one mission; the slowest in simulated time takes twenty seconds
SHARING = 48  # most missions that share a flight
_AHEAD = 5000  # missions to read ahead in search of some that share a flight
_GIVE_UP = 5  # end the campaign after this many failed starts if no mission could begin
_LOOK_S = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """Options for running a campaign. None of them affects the results of its missions.

    Attributes:
        jobs: number of concurrent missions.
        limit_s: wall time limit of one mission, in seconds; a longer mission is recorded as `hang`.
            None selects LIMIT_S, and for a mission in real time its time limit in addition.
        task: name of the module that flies a mission.
        whole: fly every mission from its own start, instead of forking several from a shared
            flight. The records are the same.
        errors: retry missions that could not begin.
        cluster: address of a dask.distributed scheduler; None for workers on this machine.
        cluster_key: folder with the cluster's keys, required for a tls:// address; see
            `cluster_keys.make_keys`.
        only: numbers of the missions to fly; None flies all.
        kept: numbers of missions whose run folders are kept regardless of `keep`.
        profiles: folder of instruction-level profiles that several campaigns share. None selects
            the campaign's own folder, where a profile is removed after the last mission that needs
            it.
        planned: numbers of the missions to fly now or in a later call; a profile is removed after
            the last of them that needs it. None means all.
        programs: programs that the folder's missions are allowed to execute; see
            `MissionConfig.require_programs`.
    """

    jobs: int = 0  # 0 selects the number of cores
    keep: Keep = Keep.FAILURES
    limit_s: float | None = None
    task: str = TASK
    whole: bool = False
    errors: bool = False
    cluster: str | None = None
    cluster_key: Path | None = None
    only: frozenset[int] | None = None
    kept: frozenset[int] = frozenset()
    profiles: Path | None = None
    planned: frozenset[int] | None = None
    programs: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        if self.limit_s is not None and not 0.0 < self.limit_s < math.inf:
            raise ConfigError(f"must be above 0 and finite, got {self.limit_s:g}", key="limit")
        if self.cluster is not None and not _is_address(self.cluster):
            # dask would retry for half a minute, and then raise a traceback
            problem = f"must be an address such as tls://host:8786, got {self.cluster!r}"
            raise ConfigError(problem, key="cluster")
        if (self.cluster or "").startswith("tls://") != (self.cluster_key is not None):
            problem = (
                "a tls:// address requires --cluster-key, and other addresses do not accept it"
            )
            raise ConfigError(problem, key="cluster")


def _is_address(text: str) -> bool:
    try:
        parts = urlsplit(text)
        return bool(parts.scheme and parts.hostname and parts.port)
    except ValueError:  # such as a port that is not a number
        return False


def run_campaign(
    missions: Sequence[PlannedMission],
    folder: Path,
    options: Options | None = None,
    spectator: Spectator | None = None,
    *,
    append: bool = False,
    stop: Stop | None = None,
) -> Ledger:
    """Fly the missions that have no result in the campaign's folder yet.

    Args:
        missions: the campaign's list of missions.
        folder: the campaign's folder, with ledger.sqlite and the kept run folders in runs/.
        options: how to run the missions.
        spectator: observes the progress.
        append: add missions that the list stored in the folder lacks.
        stop: the stopping rule; None flies all missions.

    Returns:
        The campaign's ledger, open for reading. Its `results()` are in the order of the list.

    Raises:
        ConfigError: the folder holds another list, versions or files have changed since it was
            stored, or another process is writing to the folder.
        CampaignStopped: a problem with the machine prevents further flights.
        RecordError: the ledger cannot be written.
        Interrupted: the user pressed Ctrl-C; a second one kills the missions in flight.
    """
    with Ledger(folder, writing=True) as ledger:
        store_plan(ledger, missions, append=append)
        options = options or Options()
        named = {name for mission in missions for name in mission.config.programs}
        options = replace(options, programs=options.programs | named)
        fly_missing(ledger, options, spectator or Spectator(), stop)
    return Ledger(folder)


def store_plan(
    ledger: Ledger,
    missions: Sequence[PlannedMission],
    *,
    append: bool = False,
    differing: Sequence[str] = (),
    can_append: str = "",
) -> None:
    """Store a campaign's list of missions. If a list is already stored, check that both are equal.

    Args:
        append: add missions that the stored list lacks, instead of raising an error. Stored
            missions are never removed.
        differing: descriptions of the differences between the lists, for the error message. If
            empty, the message shows the first mission that only the new list contains, and the
            first that only the stored list contains.
        can_append: instructions for appending missions, which the error message includes if the
            new list only adds missions.

    Raises:
        ConfigError: the stored list differs, or versions or files have changed; see
            `require_unchanged`.
    """
    require_unchanged(ledger)
    left = Counter(row[1:] for row in ledger.rows())
    stored = left.total()
    new = []
    for mission in missions:
        row = mission.stored
        if left[row]:
            left[row] -= 1
        else:
            new.append(mission)
    if stored and not append and (new or left.total()):
        firsts = {"new": [mission.stored for mission in new], "gone": [*+left]}
        examples = [f"the first {how} one is {a[0][0]} {a[0][2]}" for how, a in firsts.items() if a]
        reasons = [*differing] or examples
        reasons.append(
            f"{stored} missions there, {len(missions)} here, of which {len(new)} are new"
        )
        remedy = "choose another folder"
        if left.total():
            reasons[-1] += f", and {left.total()} are gone"
        elif can_append:
            remedy = f"{can_append}, or {remedy}"
        raise ConfigError(
            f"holds another campaign: {'; '.join([*reasons, remedy])}", path=ledger.folder
        )
    _note_files(ledger, new)
    ledger.plan(new)


def fly_missing(
    ledger: Ledger,
    options: Options,
    spectator: Spectator,
    stop: Stop | None = None,
    rounds: Rounds | None = None,
) -> None:
    """Fly every mission that has no result yet, unless the stopping rule has ended its setting.

    Args:
        rounds: the rounds in which a stratified campaign draws its faults; None if it is uniform.

    Raises:
        MavfiError: as `run_campaign`.
    """
    run = _Run(ledger, options, spectator, stop, rounds)
    with _prepared(ledger.folder, run.profiles), interruptible() as interrupts:
        run.fly(interrupts)


@contextlib.contextmanager
def _prepared(folder: Path, profiles: Path) -> Iterator[None]:
    """Create the folders for attempts and profiles, and remove the former after the block.

    The folder for attempts is emptied first.
    """
    work = own_folder(folder / WORK)
    shutil.rmtree(work, ignore_errors=True)
    for path in (work, profiles):
        own_folder(path)
    try:
        yield
    finally:
        shutil.rmtree(work, ignore_errors=True)


class MissionQueue:
    """A queue of the missing missions, in list order. A stopping rule admits them in batches.

    Args:
        missing: iterator over the missions without a result. It yields None while the fault of the
            next mission has not been drawn yet.
        stop: the stopping rule; None admits all missions.
        cells: number of each mission's setting, in the order of the list; needed only with `stop`.
        over: for each finished mission, its number, and its outcome with the fate of its fault.
        shares: whether missions may share a flight.
        drawn: the draw of each mission of a stratified campaign, keyed by mission number.
        stopped: set to which the queue adds the numbers of the settings that the rule ends; None
            creates a new set.

    Attributes:
        stopped: numbers of the settings that the rule has ended.
    """

    def __init__(
        self,
        missing: Iterator[MissingMission | None],
        stop: Stop | None,
        cells: Sequence[int] = (),
        over: Iterable[tuple[int, Row]] = (),
        *,
        shares: bool = False,
        drawn: Mapping[int, Drawn] | None = None,
        stopped: set[int] | None = None,
    ) -> None:
        self._shares = shares
        self._missing, self._stop, self._cells = missing, stop, cells
        self._read: dict[int, OrderedDict[int, MissingMission]] = {}  # by setting
        self._sharing: dict[MissionConfig, dict[int, int]] = {}  # number -> setting, by flight
        self._members: dict[int, list[int]] = {}
        self._place: list[int] = []
        for number, cell in enumerate(cells):
            members = self._members.setdefault(cell, [])
            self._place.append(len(members))
            members.append(number)
        self._open = dict.fromkeys(self._members, stop.batch if stop else 0)
        self._over: dict[int, Row] = {}
        self._finished: Counter[int] = Counter()  # number of admitted missions that have finished
        self._drawn = {} if drawn is None else drawn
        self.stopped: set[int] = set() if stopped is None else stopped
        for number, row in over if stop else ():
            self.record(number, row)

    def next(self) -> MissingMission | None:
        """Return the next mission that may begin, or None if no mission may begin at the moment."""
        while True:
            heads = {next(iter(read)): cell for cell, read in self._read.items() if read}
            ready = [number for number in heads if self._passes(number)]
            if ready:
                first = min(ready)
                return self._take(first, heads[first])
            if not self._read_one():
                return None

    def mates(self, mission: MissingMission, most: int) -> list[MissingMission]:
        """Remove and return at most `most` missions that can share the flight of `mission`.

        Only missions that may begin now are returned.
        """
        if not self._shares:
            return []
        while sum(map(len, self._read.values())) < _AHEAD and self._read_one():
            pass
        flight = mission.config.shared_flight
        waiting = {} if flight is None else self._sharing.get(flight, {})
        ready = [number for number in sorted(waiting) if self._passes(number)]
        return [self._take(number, waiting[number]) for number in ready[:most]]

    def _read_one(self) -> bool:
        """Read the next mission. Return False if the list has ended, or has to wait for a draw."""
        mission = next(self._missing, None)
        if mission is None:
            return False
        cell = mission.cell if self._stop else 0
        if cell not in self.stopped:
            self._read.setdefault(cell, OrderedDict())[mission.number] = mission
            if self._shares and (flight := mission.config.shared_flight) is not None:
                self._sharing.setdefault(flight, {})[mission.number] = cell
        return True

    def _take(self, number: int, cell: int) -> MissingMission:
        mission = self._read[cell].pop(number)
        if self._shares and (flight := mission.config.shared_flight) is not None:
            del self._sharing[flight][number]
            if not self._sharing[flight]:
                del self._sharing[flight]
        return mission

    def _passes(self, number: int) -> bool:
        if self._stop is None:
            return True
        cell = self._cells[number]
        return cell not in self.stopped and self._place[number] < self._open[cell]

    def record(self, number: int, row: Row) -> None:
        """Record that a mission has ended. After a full batch, check the stopping rule.

        The rule then ends the mission's setting, or the setting's next batch is admitted.
        """
        if self._stop is None:
            return
        cell = self._cells[number]
        self._over[number] = row
        if self._place[number] < self._open[cell]:
            self._finished[cell] += 1
        # All admitted missions of the setting have ended, and more are on the list.
        while self._finished[cell] == self._open[cell] < len(self._members[cell]):
            if cell in self.stopped or self._narrow(cell, self._stop):
                self.stopped.add(cell)
                for number in list(self._read.get(cell, ())):
                    self._take(number, cell)
                return
            first = self._open[cell]
            self._open[cell] += self._stop.batch
            batch = self._members[cell][first : self._open[cell]]
            self._finished[cell] += sum(number in self._over for number in batch)

    def _narrow(self, cell: int, stop: Stop) -> bool:
        numbers = self._members[cell][: self._open[cell]]
        rows = [self._over[number] for number in numbers]
        draws = [self._drawn.get(number) for number in numbers]
        share = weighted_share(
            [outcome == "success" for outcome, _ in rows],
            [injected in COUNTED for _, injected in rows],
            [1.0 if draw is None else draw.weight for draw in draws],
            [None if draw is None else draw.stratum for draw in draws],
            confidence=stop.confidence,
        )
        return (share.high - share.low) / 2.0 <= stop.margin


def _may_leave_network() -> bool:
    """Return True if the operating system allows this process's forks to call `leave_network`."""
    _, status = os.waitpid(fork(lambda: 0 if leave_network() else 1), 0)
    return status == 0


class _Run:
    def __init__(
        self,
        ledger: Ledger,
        options: Options,
        spectator: Spectator,
        stop: Stop | None,
        rounds: Rounds | None,
    ) -> None:
        self._ledger = ledger
        self._options = options
        self._spectator = spectator
        self._folder = ledger.folder.absolute()
        over = partial(ledger.fates, errors=not options.errors)
        self._jobs = options.jobs or len(os.sched_getaffinity(0))
        only = options.only
        missing: Iterator[MissingMission | None] = ledger.missing(errors=options.errors)
        stopped: set[int] = set()
        if rounds is not None:
            missing = rounds.missing(stopped, errors=options.errors)
        wanted = (m for m in missing if m is None or only is None or m.number in only)
        cells = ledger.mission_cells() if stop else ()
        shares = options.task == TASK and not options.whole
        drawn = {} if rounds is None else rounds.drawn
        self._queue = MissionQueue(
            wanted, stop, cells, over(), shares=shares, drawn=drawn, stopped=stopped
        )
        self._again: list[MissingMission] = []
        self._parallel = self._jobs > 1 and options.cluster is None
        self._leaves_network: bool | None = None  # None: not tried yet
        self._noted: set[str] = set()
        self._alone: dict[int, str] = {}  # reasons why missions do not share a flight
        self._flying: dict[int, MissingMission] = {}
        self._attempts: Counter[int] = Counter()
        self._given_up: dict[int, str] = {}
        self.profiles = (options.profiles or self._folder / PROFILES).absolute()
        self._sharing = Counter(
            mission.config.golden
            for mission in ledger.missing(errors=options.errors)
            if mission.config.instruction is not None
            and options.profiles is None
            and rounds is None  # draws may move to another golden flight
            and (options.planned is None or mission.number in options.planned)
        )
        names = [str(labels.get("setting", "")) for labels in ledger.cells()]
        self._setting_of = [names[cell] for cell in ledger.mission_cells()]
        self._outcomes = {name: Counter[str]() for name in names}
        self._errors = self._repeated = 0
        self._inside_s = 0.0
        self._total = ledger.planned() if only is None else len(only)
        self._before = sum(only is None or number in only for number, _ in over())
        self._over = self._before
        self._begun = time.monotonic()

    def fly(self, interrupts: Sequence[int]) -> None:
        """Fly until no mission is missing or the user interrupts."""
        announced, options = False, self._options
        fleet: LocalWorkers | Cluster
        if options.cluster is None:
            fleet = LocalWorkers(self._jobs, options.task)
        else:
            fleet = Cluster(options.cluster, options.keep, options.task, options.cluster_key)
        with contextlib.closing(fleet) as workers:
            while len(interrupts) < 2:
                self._fill(workers, interrupts)
                if not workers.flights:
                    break
                over = workers.wait(_LOOK_S)
                if not interrupts:
                    self._note_unforked(over)
                self._fill(workers, interrupts)  # so that missions fly while the ledger is written
                for ended in over:
                    self._take(ended)
                self._spectator.on_progress(self._progress(workers.flights))
                if interrupts and self._flying and not announced:
                    announced = True
                    workers.halt()
                    self._spectator.on_note("finishing what flies; Ctrl-C once more ends it")
        if self._options.profiles is None and not self._sharing:
            shutil.rmtree(self.profiles, ignore_errors=True)  # an interruption may have left some
        self._spectator.on_end(self._progress(0))
        if interrupts:
            raise Interrupted("interrupted; run again to continue")
        if self._given_up:
            number, reason = next(iter(sorted(self._given_up.items())))
            raise CampaignStopped(
                f"{len(self._given_up)} missions failed {ATTEMPTS} times for external reasons; "
                f"the first is mission {number} ({reason}). If memory is short, use fewer --jobs"
            )

    def _fill(self, workers: LocalWorkers | Cluster, interrupts: Sequence[int]) -> None:
        while workers.free and not interrupts:
            missions = self._next()
            if not missions:
                return
            if self._must_wait(missions[0].config):
                self._again += missions
                return
            attempts: list[Attempt] = []
            alone = self._alone.pop(missions[0].number, "")
            for mission in missions:
                number, _, config = mission
                config.require_programs(*self._options.programs)
                self._attempts[number] += 1
                self._flying[number] = mission
                attempts.append((number, changes_of(config), self._made(number)))
            workers.start(attempts, self._limit_s(missions[0].config), alone)

    def _limit_s(self, config: MissionConfig) -> float:
        given_s = self._options.limit_s
        return LIMIT_S + config.paced_s if given_s is None else given_s

    def _next(self) -> list[MissingMission]:
        """Return the missions of the next flight: one, or several that share it."""
        if self._again:
            return [self._again.pop()]
        if (mission := self._queue.next()) is None:
            return []
        left = self._total - self._over - len(self._flying)
        most = min(SHARING, math.ceil(left / self._jobs))  # so that the last flights end together
        return [mission, *self._queue.mates(mission, most - 1)]

    def _must_wait(self, config: MissionConfig) -> bool:
        """Return True if a mission of a user's companion must wait for a port of this machine.

        That is so while another such mission flies, if the companion has a fixed port and its
        missions have no networks of their own. Tell the user, once.
        """
        if not self._parallel or config.companion is None:
            return False
        companion = CompanionConfig.load(config.companion)
        if companion.own_network and self._leaves_network is None:
            self._leaves_network = _may_leave_network()
        if companion.own_network and self._leaves_network:
            return False
        why, ports = "no network namespaces are allowed here", companion.fixed_ports
        if not companion.own_network:
            why = f"{config.companion} sets own_network = false"
        if ports:
            self._note_once(
                f"{why}, so missions that use port {' and '.join(map(str, ports))} of this machine "
                "fly one at a time"
            )
        elif companion.own_network:
            self._note_once(
                f"{why}, so missions share the machine's ports: a companion with a fixed port "
                "needs --jobs 1"
            )
        return bool(ports) and any(own.config.companion for own in self._flying.values())

    def _note_once(self, text: str) -> None:
        if text not in self._noted:
            self._noted.add(text)
            self._spectator.on_note(text)

    def _note_unforked(self, over: Sequence[AttemptEnd]) -> None:
        """Remember which missions could not be forked, and why, so that they are flown alone."""
        reasons = {ended.number: ended.unforked for ended in over if ended.unforked}
        self._alone |= reasons
        for reason, count in Counter(reasons.values()).items():
            self._spectator.on_note(f"missions to be flown alone: {count}; {reason}")

    def _made(self, number: int) -> Path:
        out = self._out(number)
        with writing(out):
            out.mkdir()
            (out / CACHE).symlink_to(self.profiles)
        return out

    def _out(self, number: int) -> Path:
        return self._folder / WORK / f"{number}-{self._attempts[number]}"

    def _take(self, ended: AttemptEnd) -> None:
        number = ended.number
        mission = self._flying.pop(number)
        self._inside_s += ended.wall_s
        out = self._out(number)
        if ended.unforked:
            shutil.rmtree(out, ignore_errors=True)
            self._attempts[number] -= 1
            self._again.append(mission)
            return
        verdict = ended.judge(out, mission.config, self._limit_s(mission.config))
        last = self._attempts[number] >= ATTEMPTS
        if (verdict.state is None or verdict.doubtful) and not last:
            self._repeated += 1
            self._spectator.on_note(f"mission {number}: {verdict.reason}; begun again")
            self._again.append(mission)
        elif verdict.state is None:
            self._given_up[number] = verdict.reason
        else:
            self._settle(ended, verdict, mission.config)
            self._forget_profiles(mission.config)
        shutil.rmtree(out, ignore_errors=True)

    def _forget_profiles(self, config: MissionConfig) -> None:
        """Remove the profiles of a mission's golden run if no other missing mission needs them."""
        if (golden := config.golden) not in self._sharing:
            return
        if config.instruction is not None:
            self._sharing[golden] -= 1
        if not self._sharing[golden]:
            del self._sharing[golden]
            kept = kept_in(self.profiles, golden.with_firmware())
            shutil.rmtree(kept, ignore_errors=True)

    def _settle(self, ended: AttemptEnd, verdict: AttemptResult, config: MissionConfig) -> None:
        """Store a finished mission: first its run folder, if it is kept, then its ledger row."""
        assert verdict.state is not None
        number, path, flight = ended.number, None, FlightRecord.of(verdict.result)
        outcome = flight.outcome or None
        keeps = number in self._options.kept or self._options.keep.wants(number, outcome)
        if verdict.run is not None and keeps:
            place = _put_away(verdict.run, self._folder / RUNS, number)
            path = str(place.relative_to(self._folder))
        flown = verdict.state is ResultState.FLOWN
        faulty = config.fault is not None or config.instruction is not None
        injected = Injected.of(flight, faulty=faulty) if flown else None
        self._ledger.add(
            number,
            state=verdict.state,
            result=verdict.result,
            reason=verdict.reason,
            injected=injected,
            wall_s=ended.wall_s,
            attempts=self._attempts.pop(number),
            path=path,
        )
        self._over += 1
        self._queue.record(number, (outcome, None if injected is None else injected.value))
        if flown:
            self._outcomes[self._setting_of[number]][str(outcome)] += 1
            return
        self._errors += 1
        self._spectator.on_note(f"mission {number} could not be flown: {verdict.reason}")
        if self._errors >= _GIVE_UP and not any(self._outcomes.values()):
            raise CampaignStopped(f"no mission could begin; the last failed with: {verdict.reason}")

    def _progress(self, flights: int) -> Progress:
        return Progress(
            total=self._total,
            before=self._before,
            over=self._over,
            running=flights,
            again=self._repeated,
            elapsed_s=time.monotonic() - self._begun,
            inside_s=self._inside_s,
            workers=self._jobs if self._options.cluster is None else None,
            outcomes=self._outcomes,
        )


def _put_away(run: Path, runs: Path, number: int) -> Path:
    """Move a run folder into the folder of kept runs, and return its new path."""
    stem = run.name.rpartition("-")[0] if (run / RESULT).is_file() else "cut-off"
    place = own_folder(runs) / f"{number:06d}-{stem}"
    sync_folder(run)
    with writing(place):
        for old in runs.glob(f"{number:06d}-*"):  # from an attempt whose row was never written
            shutil.rmtree(old)
        run.replace(place)
    return place


def require_unchanged(ledger: Ledger) -> None:
    """Check that versions and mission files are the same as when the campaign began.

    If the ledger does not store versions yet, store the installed ones.

    Raises:
        ConfigError: a version or a file has changed.
    """
    versions = installed_versions()
    stored = ledger.meta("versions")
    if stored is None:
        ledger.set_meta({"versions": canonical(versions)})
    elif stored != canonical(versions):
        differing = version_differences(json.loads(stored), versions)
        raise ConfigError(
            "cannot be continued, because versions have changed since it began (install the "
            f"earlier ones, or choose another folder): {'; '.join(differing)}",
            path=ledger.folder,
        )
    noted = json.loads(ledger.meta("files") or "{}")
    changed = [name for name, digest in noted.items() if digest != file_digest(name)]
    if changed:
        raise ConfigError(
            f"{', '.join(changed)}: changed after the campaign began; choose another folder",
            path=ledger.folder,
        )


def _note_files(ledger: Ledger, missions: Iterable[PlannedMission]) -> None:
    """Store digests of the files that missions name, so that `require_unchanged` can check them."""
    noted = json.loads(ledger.meta("files") or "{}")
    named = {name for mission in missions for name in mission.config.files}
    new = {name: file_digest(name) for name in sorted(named - noted.keys())}
    if new:
        ledger.set_meta({"files": canonical({**noted, **new})})
