"""`make fuzz`, or `python -m tests.robustness.fuzz [parser …] [minutes=5]`: every parser gets damaged, hostile files.

Valid files are cut, spliced, flipped and filled with extreme numbers by hypothesis, which shrinks what it finds. A
parser may succeed or raise what it documents; anything else, a hang of 20 s or 4 GB more memory than before is a
failure. Each parser runs in a process of its own, as many at once as there are cores. The file that failed is kept.
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

SECONDS_EACH = 20.0
MEMORY = 4 * 2**30
FAILED = "**failed**"
KEPT = Path("outputs") / "fuzz"
"""Where files that failed are."""

TOLD = 100, 300
"""Last lines of what a process said that are shown if it failed, and letters of each: examples are long."""

BURST = 100
"""Files between looks at the clock."""

GRACE = 900.0
"""Seconds that a process may take beyond its minutes: to import, for its last burst and to shrink what it found."""

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
    """A valid file after one to five mishaps."""
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
    """Too much time or memory: nothing that `except Exception` or a documented error could swallow."""


def peak(anew: bool = False) -> int:
    """The most memory that this process held, bytes; `anew`: what it holds now, from which the most counts again."""
    if anew:
        Path("/proc/self/clear_refs").write_text("5")
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


@contextmanager
def watched() -> Iterator[None]:
    """Bound the time and the memory of what is done, even where it swallows every error.

    Where C code holds the interpreter, the process ends after twice the time, telling where it was.

    Raises:
        ExcessError: if it takes more.
    """

    def stop(*_: object) -> None:
        raise ExcessError(f"still at one file after {SECONDS_EACH:g} s")

    begin, most = monotonic(), peak(anew=True) + MEMORY
    before = signal.signal(signal.SIGALRM, stop)
    faulthandler.dump_traceback_later(2 * SECONDS_EACH, exit=True, file=sys.__stderr__)
    signal.setitimer(signal.ITIMER_REAL, SECONDS_EACH, 1.0)  # again and again: it may be swallowed
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        faulthandler.cancel_dump_traceback_later()
        signal.signal(signal.SIGALRM, before)
    if monotonic() - begin > SECONDS_EACH:
        stop()
    if peak() > most:
        raise ExcessError(f"one file took more than {MEMORY / 2**30:g} GiB of memory")


def survives(parser: Parser, files: int, number: int, path: Path) -> None:
    """Give a parser so many damaged files, one after the other at a path, where the one that fails stays."""

    @seed(number)
    @settings(
        max_examples=files,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
        phases=[Phase.generate, Phase.shrink],
    )
    @given(content=damaged(list(parser.examples())))
    def check(content: bytes) -> None:
        path.unlink(missing_ok=True)  # the file before may still be mapped into memory
        path.write_bytes(content)
        with watched(), suppress(*parser.documented):
            parser.parse(path)

    check()
    path.unlink()


def fuzz(parser: Parser, minutes: float) -> int:
    """Damaged files given to a parser within the time."""
    path = KEPT / parser.name
    path.parent.mkdir(parents=True, exist_ok=True)
    for example in parser.examples():  # so that all is imported and every thread has begun
        path.write_bytes(example)
        parser.parse(path)
    limit_memory()
    end, files = monotonic() + 60 * minutes, 0
    while monotonic() < end:
        survives(parser, BURST, 2**20 * date.today().toordinal() + files, path)  # another day, other files
        files += BURST
    return files


def limit_memory() -> None:
    """Refuse this process more memory than it has and a parser may take.

    A quarter more than that, so that a parser which swallows the refusal was seen to take too much before.
    """
    has = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (has + MEMORY * 5 // 4,) * 2)


def main(words: list[str]) -> int:
    """Fuzz the parsers named, or all."""
    asked = next((word.partition("=")[2] for word in words if word.startswith("minutes=")), "5")
    try:
        minutes = check_range("minutes", float(asked), 0, 600, open_low=True)
    except ValueError:
        sys.exit(f"fuzz: got minutes={asked}, expected a number in (0, 600]")
    names = [word for word in words if not word.startswith("minutes=")]
    by_name = {parser.name: parser for parser in PARSERS}
    if unknown := set(names) - set(by_name):
        sys.exit(f"fuzz: got {', '.join(sorted(unknown))}, expected any of: {', '.join(by_name)}")
    if len(names) == 1 and "--here" in sys.argv:
        print(fuzz(by_name[names[0]], minutes))
        return 0
    rows = {line.split()[1]: line for line in read_part("fuzz")[2:]}
    names, failed = names or list(by_name), 0
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        running = {pool.submit(apart, name, minutes): name for name in names}
        for done in as_completed(running):
            name, outcome = running[done], done.result()
            failed += outcome == FAILED
            rows[name] = f"| {name} | {date.today()} | {minutes:g} | {outcome} |"
            head = ["| parser | day | minutes | damaged files |", "|---|---|---|---|"]
            write_part("fuzz", "\n".join(head + [rows[name] for name in by_name if name in rows]))
    return int(failed > 0)


def apart(name: str, minutes: float) -> str:
    """Fuzz one parser in a process of its own; how it went."""
    command = [sys.executable, "-m", "tests.robustness.fuzz", name, f"minutes={minutes}", "--here"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=60 * minutes + GRACE)
    except subprocess.TimeoutExpired as error:
        print(f"{name}: {error}", flush=True)
        return FAILED
    if done.returncode:
        lines = [line[: TOLD[1]] for line in done.stderr.splitlines()[-TOLD[0] :]]
        print(f"{name}: failed with {done.returncode} at {KEPT / name}", *lines, sep="\n", flush=True)
        return FAILED
    files = done.stdout.split()[-1]
    print(f"{name}: {files}", flush=True)
    return files


if __name__ == "__main__":
    sys.exit(main([word for word in sys.argv[1:] if word != "--here"]))
