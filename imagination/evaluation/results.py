"""The full evaluation: from trained units to the tables and figures of a folder."""

import logging
import os
import platform
import shlex
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

import torch
from rich.console import Console

from imagination.data.datamodule import SceneData
from imagination.evaluation import credits, figures, map_files, report, single_views, tables
from imagination.evaluation.approaches import NEEDS, Setting
from imagination.evaluation.outcome import Choices, Report
from imagination.evaluation.prediction import Model, Predictor, Segmenter
from imagination.evaluation.protocol import MappingProtocol, Subject
from imagination.precision import resolved
from imagination.scenes.scene import SpareHomes

log = logging.getLogger(__name__)


class Results(NamedTuple):
    """What an evaluation found, as measured and as it stands in mapping.csv."""

    report: Report
    rows: list[tables.Row]


Describe = Callable[[Report], Sequence[tables.Row]]
"""Makes the rows of training.csv."""


def subject_of(
    data: SceneData, models: Sequence[Model | Segmenter], precision: str, keep: bool = True
) -> Subject:
    """Trained networks, answering in `precision`, in the homes of their data; units together imagine its categories."""
    observer = data.observer
    setting = Setting(
        observer.camera, observer.ego, data.layers, data.unit_categories, len(observer.categories)
    )
    names = data.unit_categories, observer.categories.names
    predictor = Predictor(models, *names, data.batch_size, precision)
    return Subject(data.pool, setting, predictor, keep)


def evaluate(
    protocol: MappingProtocol,
    data: SceneData,
    models: Sequence[Model | Segmenter],
    folder: Path,
    describe: Describe = lambda report: (),
) -> Results:
    """Choose on validation homes, measure on test homes, save maps, write and show tables and figures.

    Args:
        protocol: of the evaluation; approaches that other networks are needed for are left out.
        data: homes and views.
        models: trained networks.
        folder: tables/, figures/ and maps/ are made in it.
        describe: rows on the networks' training, for the table beside that of the maps.

    Raises:
        UserError: if a split contains none of a category, an approach that was asked for lacks its network, or the
            disk is full.
    """
    start = perf_counter()
    subject = subject_of(data, models, protocol.precision)
    asked, protocol = protocol, protocol.available(subject.predict.gives)
    if left_out := [
        name for name in asked.approaches if name not in protocol.approaches and asked.only is None
    ]:
        needed = {NEEDS[asked.approaches[name].evidence.needs or ""] for name in left_out}
        log.info("Left out: %s, which would need %s", ", ".join(left_out), "; ".join(sorted(needed)))
    for split in ("val", "test"):
        data.survey(split)
    source = data.observer.source
    choices = protocol.choose(subject, source.scenes("val"))
    homes = source.scenes("test")
    report.write_homes(folder / "tables", homes)
    found = protocol.measure(subject, homes, choices, save=lambda maps: map_files.save(folder, maps))
    beside = report.Beside(describe(found), _known(protocol, subject, choices))
    singles = single_views.measure(protocol, subject, homes, choices, data.imaginable)
    resolution = subject.setting.ego.resolution
    origin = report.Provenance(
        command_line(),
        data.seed,
        f"{hardware()}, networks in {resolved(protocol.precision)}",
        perf_counter() - start,
        report.declared_sensor(subject.setting, protocol.approaches),
    )
    report.write(folder / "tables", found, protocol, resolution, origin, beside)
    credits.write(folder / "tables", data.observer.source)
    single_views.write(folder, singles)
    rows = tables.mapping_rows(found, protocol, resolution)
    figures.write(folder / "figures", found, rows)
    screen = Console()
    screen.print(tables.to_screen(rows, "Global maps", tables.SCREEN_MAPPING))
    if paired := tables.paired_rows(found, protocol):
        screen.print(tables.to_screen(paired, "In pairs", tables.SCREEN_PAIRED))
    return Results(found, rows)


def _known(protocol: MappingProtocol, subject: Subject, choices: Choices) -> Report | None:
    """The same in homes with furniture as in training, none of which is trained on; None if none is asked for."""
    if not protocol.known_homes:
        return None
    source = subject.pool.observer.source
    if not isinstance(source, SpareHomes):
        log.warning(
            "evaluation.known_homes: the scene source %s has no homes like those of training beside them, so known "
            "furniture is not compared with unseen",
            source.name,
        )
        return None
    homes = source.spare(protocol.known_homes)
    return protocol.measure(subject, homes, choices, title="global maps of homes with known furniture")


def command_line() -> str:
    """The command that this process was started with."""
    return shlex.join(["python", "-m", f"imagination.{Path(sys.argv[0]).stem}", *sys.argv[1:]])


def hardware() -> str:
    """Processor, cores in use and GPU."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else "no GPU"
    return f"{_processor()}, {cores} cores, {gpu}"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:  # not Linux
        return platform.processor() or platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()
