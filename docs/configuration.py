"""Generate docs/reference/configuration.md with `python docs/configuration.py`; a test checks that it is current."""

from pathlib import Path

from imagination.config.key_roles import KEYS, Key
from imagination.utils.tabular import markdown_row

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "reference" / "configuration.md"

HEAD = """# Configuration

All options and keys, generated from `conf/` and `imagination/config/key_roles.py` by `python docs/configuration.py`.

- `group=option` selects an option of a group (`experiment=chair_unet`, `model/encoder=timm`, `scale=test`,
  `mapping/registration=mean`), and `key=value` sets any key (`kernels.imaginable=1.2`). `--help` lists the groups,
  `--cfg job` prints the composed config. A misspelt name is refused with the closest ones.
- `+experiment=chair_unet` means the same as `experiment=chair_unet`. Otherwise `+` adds an argument of a `_target_`
  (`+trainer.gradient_clip_val=1`) or a row of a table (`+categories.sofa={…}`).
- `???` marks the values that a scale sets. Experiments come after the scale, so an experiment may set them, too.
- `${…}` refers to the value of another key: change that key.
- Plugins add options; `python -m imagination.plugins` lists them.

## Groups of a run

- `logger=tensorboard|csv|wandb|mlflow|many`, a list such as `logger=[tensorboard,wandb]`, or `logger=null` for none.
  wandb and mlflow need `pip install -e '.[wandb]'` or `'.[mlflow]'`. Pictures, hyperparameters and
  the printed hints follow the loggers.
- `trainer=default|cpu|gpu|ddp`. Any argument of `lightning.Trainer` is respected or refused by name
  ([Lightning](lightning.md)).
- `debug=default|fdr|limit|overfit|profiler`: one epoch on the CPU with checks, one step of each stage, a few
  batches, the same few views in every epoch, the time of each hook. Runs are in `outputs/debug/`.
- `extras.print_config=true` prints the config, `extras.tags=[a,b]` describes a run, `extras.ignore_warnings=true`
  hides warnings.
- `model/optimizer=adam|adamw|sgd` and `model/scheduler=cosine|constant|step`.
- `conf/local/default.yaml`, which git ignores, holds settings of this machine, such as `paths: {cache:
  /scratch/cache}` with `# @package _global_` as its first line.
- `train=false` with `resume=<run folder>` only evaluates the run again; `test=false` only trains. A search maximises
  `optimized_metric`.
- `hydra/launcher=submitit_slurm` runs the jobs of a sweep as SLURM jobs; it needs `pip install
  -e '.[slurm]'`.

## Keys

The **role** of a key decides what may set it and what depends on it:

- *training*: changes the result of a training. A checkpoint stores it; a resumed run keeps it, unless it is marked
  *resumable*.
- *evaluation*: changes only the evaluation. Trainings that differ only in such keys are one training.
- *location*: where inputs, outputs and caches are. Never taken from a checkpoint.
- *execution*: hardware, processes and logging. Never taken from a checkpoint.
- *command*: selects jobs or runs.

A key that is not listed has the role of the node that contains it, else *training*.
"""


def keys() -> str:
    """Return the table of keys."""
    lines = [
        markdown_row(["key", "role", "range", "unit", "in the paper", "earlier names"]),
        markdown_row(["---"] * 6),
    ]
    for name, row in KEYS.items():
        effect = f"{row.role}, resumable" if row.resumable else str(row.role)
        old = ", ".join(f"`{old}`" for old in row.old)
        lines.append(markdown_row([f"`{name}`", effect, bounds(row), row.unit, row.symbol, old]))
    return "\n".join(lines)


def bounds(row: Key) -> str:
    """Return the range of a number as text."""
    return "" if row.low is None or row.high is None else f"{row.low:,} to {row.high:,}"


def page() -> str:
    """Return the text of the page: the keys, then the files of the conf tree, top level first."""
    files = sorted(
        (path for path in (ROOT / "conf").rglob("*.yaml") if path.parent.name != "local"),
        key=lambda path: (len(path.relative_to(ROOT).parts) > 2, path),
    )
    parts = [HEAD, keys(), "\n## Files\n"]
    for path in files:
        name = path.relative_to(ROOT / "conf").with_suffix("").as_posix()
        parts.append(f"### {name}\n\n```yaml\n{path.read_text().rstrip()}\n```\n")
    return "\n".join(parts)


if __name__ == "__main__":
    PAGE.write_text(page())
