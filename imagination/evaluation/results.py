"""The full evaluation: from trained units to the tables and figures of a folder."""

import os
import platform
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

import torch
from rich.console import Console

from imagination.data.datamodule import SceneData
from imagination.evaluation import credits, figures, report, tables
from imagination.evaluation.approaches import Setting
from imagination.evaluation.outcome import Report
from imagination.evaluation.prediction import Model, Predictor
from imagination.evaluation.protocol import MappingProtocol, Subject


class Results(NamedTuple):
    """What an evaluation found, as measured and as it stands in mapping.csv."""

    report: Report
    rows: list[tables.Row]


def subject_of(data: SceneData, models: Sequence[Model]) -> Subject:
    """Trained units in the homes of their data; together they imagine its categories, in that order."""
    observer = data.observer
    setting = Setting(
        observer.camera, observer.ego, data.layers, data.unit_categories, len(observer.categories)
    )
    return Subject(data.pool, setting, Predictor(models, data.batch_size))


def evaluate(protocol: MappingProtocol, data: SceneData, models: Sequence[Model], folder: Path) -> Results:
    """Choose on validation homes, measure on test homes, write and show tables and figures.

    Args:
        protocol: of the evaluation.
        data: homes and views.
        models: trained units.
        folder: tables/ and figures/ are made in it.

    Raises:
        UserError: if a split contains none of a category, or the disk is full.
    """
    start = perf_counter()
    for split in ("val", "test"):
        data.survey(split)
    subject = subject_of(data, models)
    choices = protocol.choose(subject, data.observer.source.scenes("val"))
    found = protocol.measure(subject, data.observer.source.scenes("test"), choices)
    resolution = subject.setting.ego.resolution
    origin = report.Provenance(
        command_line(),
        data.seed,
        hardware(),
        perf_counter() - start,
        report.declared_sensor(subject.setting, protocol.approaches),
    )
    report.write(folder / "tables", found, protocol, resolution, origin)
    credits.write(folder / "tables", data.observer.source)
    rows = tables.mapping_rows(found, protocol, resolution)
    figures.write(folder / "figures", found, rows)
    screen = Console()
    screen.print(tables.to_screen(rows, "Global maps", tables.SCREEN_MAPPING))
    if paired := tables.paired_rows(found, protocol):
        screen.print(tables.to_screen(paired, "In pairs", tables.SCREEN_PAIRED))
    return Results(found, rows)


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
