"""`mavfi gate`: withhold anomalous setpoints between any companion and its autopilot."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from mavfi_cli.cli import types
from mavfi_cli.cli.grouped import GroupedCommand, given_fields, section
from mavfi_cli.core.option_types import Number, OutFile

_links, _detector = section("Links"), section("Detector")
_action = section("What it does")
_FILE = click.Path(path_type=Path, exists=True, dir_okay=False)


@click.command(cls=GroupedCommand)
@_links("--autopilot", metavar="URL", default="udpin:127.0.0.1:14550",
        help="Link to the autopilot: udpin:, udpout:, tcp:, tcpin:, serial:.")  # fmt: skip
@_links("--to", "companion", metavar="URL", default="udpin:127.0.0.1:14540",
        help="Link to the companion's programs.")  # fmt: skip
@_links("--key-file", type=_FILE, help="File with the signing passphrase of both links.")
@_links("--allow-unsigned", is_flag=True,
        help="Allow an unsigned link to reach beyond this machine.")  # fmt: skip
@_detector("--detector", type=types.DETECTOR, default="gad", metavar="NAME",
           help="Detector: gad, aad, range, l2, or the name of a plug-in.")  # fmt: skip
@_detector("--model", type=_FILE, help="Model file of `mavfi train --companion` or `--from`.")
@_detector("--threshold", type=types.ABOVE_ZERO, help="Score above which a setpoint is withheld  "
           "[the model's].")  # fmt: skip
@_detector("--companion", "file", metavar="FILE",
           help="Companion for which the model must be made  [any]. Its [gate] table and its "
                "key_file are the defaults of the options below and of "
                "--key-file.")  # fmt: skip
@_action("--action", default="hold", type=click.Choice(["hold", "brake", "autopilot"]),
         help="What takes the place of a withheld setpoint: the last accepted one, a standstill, "
              "or the autopilot's own hold.")  # fmt: skip
@_action("--patience", default=5, type=click.IntRange(0, 1000),
         help="Number of consecutive alarms after which hold becomes brake.")  # fmt: skip
@_action("--stale", "stale_s", default=1.0, type=Number(0.1, 3600.0),
         help="Time without a change after which the setpoints of a companion that is gone are "
              "withheld, s.")  # fmt: skip
@_action("--process", metavar="PID|FILE",
         help="Process of the companion, or a file with its number. When this process ends, the "
              "companion counts as gone  [only heartbeats are watched].")  # fmt: skip
@_action("--fail", "on_error", default="open", type=click.Choice(["open", "closed"]),
         help="If the gate itself fails: open passes setpoints, closed withholds "
              "them.")  # fmt: skip
@_action("--watch-only", is_flag=True, help="Report alarms, and withhold nothing.")
@_action("--log", type=OutFile(), help="File to which events are appended as lines of JSON.")
def gate(file: str | None, process: str | None, **options: Any) -> None:
    """Stand between a companion and an autopilot, and withhold anomalous setpoints.

    Everything else passes byte for byte. Alarms are printed, and sent as STATUSTEXT.
    """
    from mavfi_cli.mission.gate_process import GateProcess
    from mavfi_cli.spec.companion import CompanionConfig, GateConfig
    from mavfi_cli.spec.detector import DetectorConfig

    model = options["model"]
    detector = DetectorConfig(
        name=options["detector"], threshold=options["threshold"],
        model=None if model is None else str(model),
    )  # fmt: skip
    settings, mark, key_file = GateConfig(), None, options["key_file"]
    if file is not None:
        guarded = CompanionConfig.load(file, starts=False)
        settings, mark, key_file = guarded.gate, guarded.mark, key_file or guarded.key_file
    code = GateProcess(
        autopilot=options["autopilot"], companion=options["companion"], detector=detector,
        settings=replace(settings, **given_fields(GateConfig)), process=process, mark=mark,
        log=options["log"], key_file=key_file, allow_unsigned=options["allow_unsigned"],
    ).run()  # fmt: skip
    raise click.exceptions.Exit(code)
