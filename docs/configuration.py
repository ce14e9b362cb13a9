"""Write docs/configuration.md from the conf tree: `python docs/configuration.py`; a test checks that it is current."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "configuration.md"

HEAD = """# Configuration

Every option and every key, as it stands in `conf/`; made by `python docs/configuration.py`.

- An option of a group is chosen by `group=option` (`model/encoder=timm`, `scale=test`, `mapping/registration=mean`),
  an experiment by `+experiment=name`, any key by `key=value` (`kernels.imaginable=1.2`). `--help` lists the groups,
  `--cfg job` prints the result.
- `${…}` is another key's value: change that one. Sizes stand in `scale` alone, so `scale=paper` changes all of them.
- Plugins add options; `python -m imagination.plugins` lists them.
"""


def page() -> str:
    """The page's text: the tree's files, top level first, each under its option's name."""
    files = sorted(
        (ROOT / "conf").rglob("*.yaml"), key=lambda path: (len(path.relative_to(ROOT).parts) > 2, path)
    )
    parts = [HEAD]
    for path in files:
        name = path.relative_to(ROOT / "conf").with_suffix("").as_posix()
        parts.append(f"## {name}\n\n```yaml\n{path.read_text().rstrip()}\n```\n")
    return "\n".join(parts)


if __name__ == "__main__":
    PAGE.write_text(page())
