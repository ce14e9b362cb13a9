"""Fuzzing of parsers: `make fuzz`, or `python -m tests.robustness.fuzz [parser …] [minutes=5]`.

Hypothesis truncates, splices, flips and fills valid files with extreme values, and shrinks failing files. A parser may
succeed or raise a documented error; another error, more than 20 s or more than 4 GiB of additional memory is a failure.
Each parser runs in a separate process, as many in parallel as there are cores. Failing files are kept.
"""

import faulthandler
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager, suppress
from datetime import date
from pathlib import Path
from time import monotonic

from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

from imagination.utils.errors import check_range
from tests.robustness.page import read_part, write_part
from tests.robustness.parsers import PARSERS, Parser

MAX_SECONDS = 20.0
"""Maximum time for one file, seconds."""

MAX_MEMORY = 4 * 2**30
"""Maximum additional memory for one file, bytes."""

FAILED = "**failed**"
FAILURES = Path("outputs") / "fuzz"
"""Folder of failing files."""

MAX_LINES, MAX_LINE_LENGTH = 100, 300
"""Number of error lines shown of a failed process, and characters of each; examples are long."""

BURST = 100
"""Number of files between checks of the time."""

GRACE = 900.0
"""Additional time of a process for imports, the last burst and shrinking, seconds."""

EXTREMES = [
    *(b"\x00\x00\x00\x00", b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"\x80\x00\x00\x00"),
    *(
        b"-1",
        b"1e999",
        b"NaN",
        b"99999999999999999999",
        b"null",
        b"[]",
        b"{}",
        b'""',
        b"\xc3\x28",
        b"../../x",
    ),
    *(
        b"${oc.env:HOME}",
        b"_target_: os.system",
        b"!!python/object/apply:os.system [id]",
        b"&a [*a]",
        b"!!bool x",
        b"!!timestamp x",
        b"2026-13-45",
        b"[" * 3000,
        b"9" * 5000,
        b"\t",
        b"\n",
    ),
]


@st.composite
def damaged(draw: st.DrawFn, examples: list[bytes]) -> bytes:
    """Draw a valid file with one to five modifications."""
    content = bytearray(draw(st.sampled_from(examples)))
    for _ in range(draw(st.integers(1, 5))):
        start = draw(st.integers(0, len(content)))
        length = draw(st.integers(0, 64))
        kind = draw(st.sampled_from(["cut", "remove", "flip", "insert", "overwrite", "repeat", "random"]))
        if kind == "cut":
            del content[start:]
        elif kind == "remove":
            del content[start : start + length]
        elif kind == "flip" and start < len(content):
            content[start] ^= 1 << draw(st.integers(0, 7))
        elif kind == "insert":
            content[start:start] = draw(st.sampled_from(EXTREMES))
        elif kind == "overwrite":
            extreme = draw(st.sampled_from(EXTREMES))
            content[start : start + len(extreme)] = extreme
        elif kind == "repeat":
            content[start:start] = content[start : start + length] * draw(st.integers(1, 50))
        else:
            content[start : start + length] = draw(st.binary(max_size=64))
    return bytes(content)


class ExcessError(BaseException):
    """Too much time or memory; not an Exception, so that a parser does not catch it."""


def peak_memory(reset: bool = False) -> int:
    """Return the peak memory of this process, bytes; `reset` restarts the measurement from the current memory."""
    if reset:
        Path("/proc/self/clear_refs").write_text("5")
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


@contextmanager
def watched() -> Iterator[None]:
    """Limit the time and memory of a block, even if it catches all errors.

    If C code blocks the interpreter, the process ends after twice the time with a traceback.

    Raises:
        ExcessError: if a limit is exceeded.
    """

    def stop(*_: object) -> None:
        raise ExcessError(f"one file takes more than {MAX_SECONDS:g} s")

    begin, limit = monotonic(), peak_memory(reset=True) + MAX_MEMORY
    before = signal.signal(signal.SIGALRM, stop)
    faulthandler.dump_traceback_later(2 * MAX_SECONDS, exit=True, file=sys.__stderr__)
    signal.setitimer(signal.ITIMER_REAL, MAX_SECONDS, 1.0)  # repeated, since the block may catch the error
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        faulthandler.cancel_dump_traceback_later()
        signal.signal(signal.SIGALRM, before)
    if monotonic() - begin > MAX_SECONDS:
        stop()
    if peak_memory() > limit:
        raise ExcessError(f"one file took more than {MAX_MEMORY / 2**30:g} GiB of memory")


def check_parser(parser: Parser, files: int, random_seed: int, path: Path) -> None:
    """Parse a number of damaged files, written one after another to a path, where a failing file is kept."""

    @seed(random_seed)
    @settings(
        max_examples=files,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
        phases=[Phase.generate, Phase.shrink],
    )
    @given(content=damaged(list(parser.examples())))
    def check(content: bytes) -> None:
        path.unlink(missing_ok=True)  # the previous file may still be memory-mapped
        path.write_bytes(content)
        with watched(), suppress(*parser.documented):
            parser.parse(path)

    check()
    path.unlink()


def fuzz(parser: Parser, minutes: float) -> int:
    """Fuzz a parser for some minutes, and return the number of damaged files."""
    path = FAILURES / parser.name
    path.parent.mkdir(parents=True, exist_ok=True)
    for example in parser.examples():  # imports modules and starts threads
        path.write_bytes(example)
        parser.parse(path)
    limit_memory()
    end, files = monotonic() + 60 * minutes, 0
    while monotonic() < end:
        check_parser(parser, BURST, 2**20 * date.today().toordinal() + files, path)  # new files every day
        files += BURST
    return files


def limit_memory() -> None:
    """Limit the memory of this process to its current memory and 1.25 times MAX_MEMORY.

    The margin lets `watched` detect a parser that catches the MemoryError.
    """
    current = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (current + MAX_MEMORY * 5 // 4,) * 2)


def main(arguments: list[str]) -> int:
    """Fuzz the given parsers, or all, and return the exit code."""
    value = next((word.partition("=")[2] for word in arguments if word.startswith("minutes=")), "5")
    try:
        minutes = check_range("minutes", float(value), 0, 600, open_low=True)
    except ValueError:
        sys.exit(f"fuzz: got minutes={value}, expected a number in (0, 600]")
    names = [word for word in arguments if not word.startswith("minutes=")]
    by_name = {parser.name: parser for parser in PARSERS}
    if unknown := set(names) - set(by_name):
        sys.exit(f"fuzz: got {', '.join(sorted(unknown))}, expected any of: {', '.join(by_name)}")
    if len(names) == 1 and "--here" in sys.argv:
        print(fuzz(by_name[names[0]], minutes))
        return 0
    rows = {line.split()[1]: line for line in read_part("fuzz")[2:]}
    names, failed = names or list(by_name), 0
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        tasks = {pool.submit(fuzz_in_process, name, minutes): name for name in names}
        for task in as_completed(tasks):
            name, outcome = tasks[task], task.result()
            failed += outcome == FAILED
            rows[name] = f"| {name} | {date.today()} | {minutes:g} | {outcome} |"
            header = ["| parser | day | minutes | damaged files |", "|---|---|---|---|"]
            write_part("fuzz", "\n".join(header + [rows[name] for name in by_name if name in rows]))
    return int(failed > 0)


def fuzz_in_process(name: str, minutes: float) -> str:
    """Fuzz one parser in a separate process, and return the number of files or FAILED."""
    command = [sys.executable, "-m", "tests.robustness.fuzz", name, f"minutes={minutes}", "--here"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=60 * minutes + GRACE)
    except subprocess.TimeoutExpired as error:
        print(f"{name}: {error}", flush=True)
        return FAILED
    if done.returncode:
        lines = [line[:MAX_LINE_LENGTH] for line in done.stderr.splitlines()[-MAX_LINES:]]
        print(
            f"{name}: failed with code {done.returncode}: {FAILURES / name}",
            *lines,
            sep="\n",
            flush=True,
        )
        return FAILED
    files = done.stdout.split()[-1]
    print(f"{name}: {files}", flush=True)
    return files


if __name__ == "__main__":
    sys.exit(main([word for word in sys.argv[1:] if word != "--here"]))
