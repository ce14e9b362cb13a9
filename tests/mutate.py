"""Mutation testing: `make mutate` applies each of tests/mutations.py to a copy of the code; its tests must then fail.

A mutation that survives means a mistake of that kind would go unnoticed. A mutation whose text is no longer found is a
failure too: the list has to follow the code.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from mutations import MUTATIONS, Mutation

ROOT = Path(__file__).resolve().parents[1]


def survives(mutation: Mutation) -> bool:
    """Whether the tests still pass with the mutation in place."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        for part in ("imagination", "conf", "plugins", "tests"):
            shutil.copytree(ROOT / part, copy / part, ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copy(ROOT / "pyproject.toml", copy)
        target = copy / ("" if mutation.file.startswith("plugins/") else "imagination") / mutation.file
        text = target.read_text()
        if text.count(mutation.old) != 1:
            raise ValueError(
                f"{mutation.what}: {mutation.old!r} occurs {text.count(mutation.old)} times in {mutation.file}"
            )
        target.write_text(text.replace(mutation.old, mutation.new))
        command = [
            sys.executable,
            "-m",
            "pytest",
            "-x",
            "-q",
            "-p",
            "no:cacheprovider",
            *mutation.tests.split(),
        ]
        environment = os.environ | {"PYTHONPATH": folder, "PYTHONDONTWRITEBYTECODE": "1"}
        run = subprocess.run(command, cwd=copy, env=environment, capture_output=True, text=True, timeout=600)
        if run.returncode not in (0, 1):  # neither passed nor failed: the tests could not run
            raise RuntimeError(
                f"{mutation.what}: pytest ended with {run.returncode}\n{run.stdout}{run.stderr}"
            )
        return run.returncode == 0


def main() -> int:
    """Try every mutation, two at a time; print which survive."""
    wanted = [mutation for mutation in MUTATIONS if all(word in mutation.what for word in sys.argv[1:])]
    survivors = []
    with ThreadPoolExecutor(2) as pool:
        for mutation, alive in zip(wanted, pool.map(survives, wanted), strict=True):
            print(f"{'SURVIVED' if alive else 'killed  '} {mutation.what}", flush=True)
            survivors += [mutation.what] if alive else []
    print(f"{len(wanted) - len(survivors)} killed, {len(survivors)} survived")
    return 1 if survivors or not wanted else 0


if __name__ == "__main__":
    sys.exit(main())
